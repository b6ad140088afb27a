// npm's modbus-serial as a slave: node modbus_serial_server.js rtu DEVICE | tcp PORT
//
// Unit 1: every third coil and discrete input is on; holding register n holds n, input register n
// 1000 + n; 10000 of each, beyond them exception 02. Prints "ready" when it listens.
"use strict";

const Modbus = require("modbus-serial");

const COUNT = 10000;
const holding = Array.from({ length: COUNT }, (_, n) => n);
const coils = Array.from({ length: COUNT }, (_, n) => n % 3 === 0);

function at(cells, address) {
    if (address >= cells.length) {
        throw { modbusErrorCode: 2, msg: "no such address" };
    }
    return cells[address];
}

const vector = {
    getHoldingRegister: (address) => at(holding, address),
    getInputRegister: (address) => at(holding, address) && 1000 + address,
    getCoil: (address) => at(coils, address),
    getDiscreteInput: (address) => at(coils, address) && address % 3 === 0,
    setRegister: (address, value) => { at(holding, address); holding[address] = value; },
    setCoil: (address, value) => { at(coils, address); coils[address] = value; },
};

const [kind, where] = process.argv.slice(2);
const ready = () => console.log("ready");
if (kind === "rtu") {
    const server = new Modbus.ServerSerial(vector, {
        port: where, baudRate: 19200, parity: "none", unitID: 1, openCallback: ready,
    });
    server.on("error", (error) => { console.error(error); process.exit(1); });
} else {
    const server = new Modbus.ServerTCP(vector, { host: "127.0.0.1", port: Number(where), unitID: 1 });
    server.on("initialized", ready);
    server.on("serverError", (error) => { console.error(error); process.exit(1); });
}
