// npm's modbus-serial as a client of the slaves of benchmarks/scenarios.py:
//     node scenario_peer.js PORT LINES UNITS TAGS SECONDS
//
// Reads all numbers of all slaves once in SECONDS, one request at a time on each connection, and
// counts those that changed. Prints {"read", "changed", "late"} since the start for each line of
// input. A round is late when the one before took longer than SECONDS.
"use strict";

const { createRequire } = require("node:module");
const path = require("node:path");
const readline = require("node:readline");

const Modbus = createRequire(path.join(__dirname, "..", "tests", "interop", "peers.js"))(
    "modbus-serial",
);
const [PORT, LINES, UNITS, TAGS, SECONDS] = process.argv.slice(2).map(Number);
const MOST = 62; // numbers of a request
const counted = { read: 0, changed: 0, late: 0 };

async function line(port) {
    const client = new Modbus();
    await client.connectTCP("127.0.0.1", { port });
    const known = new Map();
    for (let due = performance.now(); ; due += SECONDS * 1000) {
        for (let unit = 1; unit <= UNITS; unit++) {
            client.setID(unit);
            for (let first = 0; first < TAGS; first += MOST) {
                const numbers = Math.min(MOST, TAGS - first);
                const { buffer } = await client.readHoldingRegisters(2 * first, 2 * numbers);
                for (let n = 0; n < numbers; n++) {
                    const [value, place] = [buffer.readUInt32BE(4 * n), unit * TAGS + first + n];
                    counted.changed += known.get(place) !== value;
                    known.set(place, value);
                }
                counted.read += numbers;
            }
        }
        const rest = due + SECONDS * 1000 - performance.now();
        counted.late += rest < 0;
        await new Promise((resolve) => setTimeout(resolve, Math.max(0, rest)));
    }
}

for (let n = 0; n < LINES; n++) {
    line(PORT + n).catch((error) => {
        console.error(error);
        process.exit(1);
    });
}
readline
    .createInterface({ input: process.stdin })
    .on("line", () => console.log(JSON.stringify(counted)))
    .on("close", () => process.exit(0));
