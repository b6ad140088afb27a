// Requests to the bench: an address that works once gives a token, which each request has.

import { byId, put } from "./dom.js";
import { said, t } from "./language.js";

const TOKEN = "bench";

export async function enter() {
  const key = location.hash.slice(1);
  if (key) {
    history.replaceState(null, "", location.pathname);
    const reply = await fetch("api/enter", { method: "POST", body: key });
    const found = await reply.json();
    if (!reply.ok) return lost(found.error);
    sessionStorage.setItem(TOKEN, found.token);
  }
  return sessionStorage.getItem(TOKEN) ? true : lost(t("open the address that the terminal shows"));
}

export function lost(why) {
  byId("lost").hidden = !why;
  put("lost", why ? t("Not connected: {why}", { why }) : "");
  return false;
}

// Returns what the bench answers. Throws an error with its sentence.
export async function call(path, data, body) {
  const options = { cache: "no-store", headers: { Authorization: `Bearer ${sessionStorage.getItem(TOKEN)}` } };
  if (data !== undefined || body) Object.assign(options, { method: "POST", body: body ?? JSON.stringify(data) });
  let reply;
  try {
    reply = await fetch(`api/${path}`, options);
  } catch {
    lost(t("the bench has ended"));
    throw new Error(t("The bench has ended."));
  }
  const found = await reply.json();
  if (reply.ok) return found;
  if (reply.status === 401) lost(t("this bench is open in another place, or was started again: open its new address"));
  throw new Error(said(found.error));
}

// Does a step of a button or a form, which waits for it; its sentence goes to `place`.
export async function step(button, place, work) {
  put(place, "");
  button.disabled = true;
  try {
    return await work();
  } catch (error) {
    put(place, error.message);
    return undefined;
  } finally {
    button.disabled = false;
  }
}
