// Reads a payload of Sparkplug B (hexadecimal) with the library of Eclipse Tahu, which knows no
// arrays. Prints the values by name, and a command (hexadecimal) that writes them.
const sparkplug = require('sparkplug-payload').get('spBv1.0')
const read = Buffer.from(require('fs').readFileSync(0, 'utf8'), 'hex')
const { metrics } = sparkplug.decodePayload(read)
const values = Object.fromEntries(metrics.map(({ name, value }) =>
  [name, value !== null && typeof value === 'object' ? value.toString() : value]))
const written = metrics.map(({ name, type, value }) => ({ name, type, value }))
const command = sparkplug.encodePayload({ timestamp: Date.now(), metrics: written })
console.log(JSON.stringify([values, Buffer.from(command).toString('hex')]))
