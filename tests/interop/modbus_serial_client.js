// npm's modbus-serial as a master: node modbus_serial_client.js DEVICE STATION [tcp]
//
// ASCII on a serial port; with `tcp` DEVICE is a port number of this machine.
//
// Writes registers and coils of a slave of ours, reads them back, asks for what it does not have
// (holding 9000). Prints what it read as one line of JSON.
"use strict";

const Modbus = require("modbus-serial");

async function main(device, station, network) {
    const master = new Modbus();
    if (network) {
        await master.connectTCP("127.0.0.1", { port: Number(device) });
    } else {
        await master.connectAsciiSerial(device, { baudRate: 19200 });
    }
    master.setID(Number(station));
    master.setTimeout(2000);
    await master.writeRegisters(100, [1, 2, 65535]);
    await master.writeRegister(103, 0xBEEF);
    await master.writeCoils(16, [true, false, true]);
    await master.writeCoil(17, true);
    const words = (await master.readHoldingRegisters(100, 4)).data;
    const bits = (await master.readCoils(16, 4)).data.slice(0, 4);
    let refused = null;
    try {
        await master.readHoldingRegisters(9000, 1);
    } catch (error) {
        refused = error.modbusCode;
    }
    console.log(JSON.stringify({ words, bits, refused }));
    master.close(() => process.exit(0));
}

main(...process.argv.slice(2)).catch((error) => { console.error(error); process.exit(1); });
