// A consumer and writer in JavaScript: node examples/read_and_write.mjs http://127.0.0.1:8080 mixer/recipe 7
// It prints every good value of the tag for --seconds (5), then writes a value, if there is one. The
// token of a writer is in GATEWAY_TOKEN. It ends with 1 unless the device acknowledged the write.
// It needs no package: the JSON API has the same documents as Zenoh (docs/page.md). Integers beyond
// 2^53 are rounded by JSON.parse.

const [base, tag, value, seconds = "5"] = process.argv.slice(2);
const headers = process.env.GATEWAY_TOKEN ? { Authorization: `Bearer ${process.env.GATEWAY_TOKEN}` } : {};

async function read() {
  const answer = await fetch(`${base}/api/tags?tags=${encodeURIComponent(tag)}`, { headers });
  if (!answer.ok) throw new Error(`${answer.status}: ${await answer.text()}`);
  const { tags: [found] } = await answer.json();
  if (!found) throw new Error(`there is no tag ${tag}`);
  if (found.quality !== "good") return `not good: ${found.quality}, ${found.reason}`; // has no value to use
  if (found.origin === "simulated" || found.origin === "replayed") return `not real: ${found.value}`;
  return `${found.value} ${found.unit}`.trim();
}

async function write() {
  const target = `${base}/api/write?tag=${encodeURIComponent(tag)}`;
  const json = { ...headers, "Content-Type": "application/json" };
  const answer = await fetch(target, { method: "POST", headers: json, body: value }).catch(() => null);
  if (answer?.status === 200) return `written: ${(await answer.json()).value}`;
  process.exitCode = 1; // 504, or no answer: unclear, it may be done. Read the value, do not repeat.
  return answer === null || answer.status === 504 ? "unclear" : `not written: ${(await answer.json()).reason}`;
}

for (const until = Date.now() + Number(seconds) * 1000, last = {}; Date.now() < until; ) {
  const now = await read();
  if (now !== last.shown) console.log((last.shown = now));
  await new Promise((wake) => setTimeout(wake, 200));
}
if (value !== undefined) console.log(await write());
