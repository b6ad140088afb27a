// npm's modbus-serial as a master that reads 64 registers again and again, for
// benchmarks/transactions.py: node modbus_serial_reads.js tcp PORT READS
//                           or: node modbus_serial_reads.js rtu DEVICE READS
//
// Prints microseconds per read: wall clock and processor time of all threads.
"use strict";

const { createRequire } = require("node:module");
const path = require("node:path");

const Modbus = createRequire(path.join(__dirname, "..", "tests", "interop", "peers.js"))(
    "modbus-serial",
);
const [FIRST, WORDS] = [100, 64];
const WARM = 5000; // reads before the first that counts: Node compiles while it runs

async function main(way, where, reads) {
    const master = new Modbus();
    if (way === "tcp") {
        await master.connectTCP("127.0.0.1", { port: Number(where) });
    } else {
        await master.connectRTUBuffered(where, { baudRate: 115200 });
    }
    master.setID(1);
    master.setTimeout(60_000);
    const count = Number(reads);
    let [begun, before] = [0n, null];
    for (let n = -WARM; n < count; n++) {
        if (n === 0) {
            [begun, before] = [process.hrtime.bigint(), process.cpuUsage()];
        }
        const { data } = await master.readHoldingRegisters(FIRST, WORDS);
        if (data.length !== WORDS) {
            throw new Error(`${data.length} registers`);
        }
    }
    const spent = process.cpuUsage(before);
    const wall = Number(process.hrtime.bigint() - begun) / 1e3;
    console.log(`${(wall / count).toFixed(1)} ${((spent.user + spent.system) / count).toFixed(1)}`);
    master.close(() => process.exit(0));
}

main(...process.argv.slice(2)).catch((error) => {
    console.error(error);
    process.exit(1);
});
