// npm's OPC UA client, controlled by commands: `node opcua_client.js FOLDER`, which has its
// certificate.pem and key.pem. It executes commands from its standard input and prints `ok` and JSON
// after each:
//
//     connect opc.tcp://127.0.0.1:4840 [MODE [USER TOKEN]]   the first command. MODE: None, Sign or
//                                            SignAndEncrypt (Basic256Sha256)
//     browse i=85                 the nodes below: their ids
//     read ns=2;s=mixer/speed     value, type, status, source time
//     meta ns=2;s=mixer/speed     data type, access level, description, unit and range
//     write ns=2;s=mixer/recipe Int16 7      the status code; `[1,2]` for an array
//     start …  /  written         the same write in the background; waits for its status code
//     history ns=2;s=mixer/speed SECONDS COUNT [back|last]   of the last seconds; `back`: the newest
//                                            first; `last`: the newest first, without a start
//     aggregate ns=2;s=mixer/speed NAME FROM TO MS   values by interval: [value, status, time]
//     alarms                      prints `alarm NAME ACTIVE ACKED SEVERITY QUALITY` from now on
//     acknowledge ns=2;s=mixer/level@alarm   its last event: the status code
//     watch ns=2;s=mixer/speed    prints `changed ns=2;s=mixer/speed STATUS VALUE` from now on
"use strict";

const readline = require("node:readline");
const ua = require("node-opcua-client");
const { OPCUACertificateManager } = require("node-opcua-certificate-manager");

const ARRAY = { arrayType: ua.VariantArrayType.Array };

function shown(value) {
    const known = value.value ? value.value.value : null;
    return {
        value: ArrayBuffer.isView(known) ? [...known] : known,
        type: value.value ? ua.DataType[value.value.dataType] : null,
        status: value.statusCode.name,
        time: value.sourceTimestamp,
    };
}

async function browse(session, nodeId) {
    const { references } = await session.browse(nodeId);
    return references.map((reference) => reference.nodeId.toString());
}

async function meta(session, nodeId) {
    const ask = (attributeId) => session.read({ nodeId, attributeId });
    const type = await ask(ua.AttributeIds.DataType);
    const access = await ask(ua.AttributeIds.AccessLevel);
    const description = await ask(ua.AttributeIds.Description);
    const about = { type: ua.DataType[type.value.value.value], access: access.value.value };
    about.description = description.value.value.text;
    for (const id of await browse(session, nodeId)) {
        const property = (await session.read({ nodeId: id })).value.value;
        if (property.displayName) about.unit = property.displayName.text;
        if ("high" in property) about.range = [property.low, property.high];
    }
    return about;
}

async function write(session, nodeId, type, text) {
    const dataType = ua.DataType[type];
    const value = type === "String" ? text : JSON.parse(text);
    const code = await session.write({
        nodeId,
        attributeId: ua.AttributeIds.Value,
        value: { value: { dataType, value, ...(Array.isArray(value) ? ARRAY : {}) } },
    });
    return code.name;
}

async function history(session, nodeId, seconds, count, order) {
    const now = new Date();
    const begin = new Date(now - seconds * 1000);
    const times = { back: [now, begin], last: [null, now] };
    const [startTime, endTime] = times[order] ?? [begin, now];
    const historyReadDetails = new ua.ReadRawModifiedDetails({
        isReadModified: false,
        startTime,
        endTime,
        numValuesPerNode: Number(count),
        returnBounds: false,
    });
    const values = [];
    let parts = 0;
    let continuationPoint;
    do {
        const { results } = await session.historyRead(
            new ua.HistoryReadRequest({
                historyReadDetails,
                nodesToRead: [{ nodeId, continuationPoint }],
                timestampsToReturn: ua.TimestampsToReturn.Both,
            })
        );
        const [result] = results;
        if (result.statusCode.isNot(ua.StatusCodes.Good)) return { status: result.statusCode.name };
        values.push(...result.historyData.dataValues.map(shown));
        continuationPoint = result.continuationPoint;
        parts += 1;
    } while (continuationPoint && continuationPoint.length);
    return { status: "Good", parts, values };
}

async function aggregate(session, nodeId, name, from, to, interval) {
    const result = await session.readAggregateValue(
        { nodeId }, new Date(from), new Date(to), ua.AggregateFunction[name], Number(interval)
    );
    if (result.statusCode.isNot(ua.StatusCodes.Good)) return { status: result.statusCode.name };
    return result.historyData.dataValues.map(shown);
}

async function watch(session, nodeId) {
    const subscription = await session.createSubscription2({
        requestedPublishingInterval: 50,
        requestedLifetimeCount: 1000,
        requestedMaxKeepAliveCount: 100,
        publishingEnabled: true,
    });
    const item = await subscription.monitor(
        { nodeId, attributeId: ua.AttributeIds.Value },
        { samplingInterval: 0, queueSize: 100 },
        ua.TimestampsToReturn.Both
    );
    item.on("changed", (value) => {
        const { status, value: known } = shown(value);
        console.log("changed", nodeId, status, JSON.stringify(known));
    });
}

const FIELDS = [
    "EventId", "ConditionName", "ActiveState.Id", "AckedState.Id", "Severity", "Quality", "EventType",
];
const events = {};

async function alarms(session) {
    const subscription = await session.createSubscription2({
        requestedPublishingInterval: 50,
        requestedLifetimeCount: 1000,
        requestedMaxKeepAliveCount: 100,
        publishingEnabled: true,
    });
    const filter = ua.constructEventFilter(FIELDS, ua.ofType("AcknowledgeableConditionType"));
    const item = await subscription.monitor(
        { nodeId: "i=2253", attributeId: ua.AttributeIds.EventNotifier },
        { samplingInterval: 0, queueSize: 100, filter },
        ua.TimestampsToReturn.Both
    );
    item.on("changed", ([id, name, active, acked, severity, quality]) => {
        events[name.value] = id.value;
        const code = quality.value.name;
        console.log("alarm", name.value, active.value, acked.value, severity.value, code);
    });
    await session.call({
        objectId: "i=2782",
        methodId: "i=3875",
        inputArguments: [{ dataType: "UInt32", value: subscription.subscriptionId }],
    });
}

async function acknowledge(session, nodeId) {
    const name = nodeId.replace("ns=2;s=", "").replace("@alarm", "");
    const code = await session.acknowledgeCondition(nodeId, events[name], "seen");
    return code.name;
}

async function main(folder) {
    const create = (securityMode) =>
        ua.OPCUAClient.create({
            clientCertificateManager: new OPCUACertificateManager({
                rootFolder: folder,
                automaticallyAcceptUnknownCertificate: true,
            }),
            certificateFile: `${folder}/certificate.pem`,
            privateKeyFile: `${folder}/key.pem`,
            applicationUri: "urn:tests:node",
            endpointMustExist: false,
            securityMode: ua.MessageSecurityMode[securityMode],
            securityPolicy: ua.SecurityPolicy[securityMode === "None" ? "None" : "Basic256Sha256"],
            connectionStrategy: { maxRetry: 0 },
        });
    let client;
    let session;
    let started;
    const commands = {
        browse,
        meta,
        write,
        history,
        watch,
        alarms,
        acknowledge,
        aggregate,
        connect: async (_, endpointUrl, mode = "None", userName = null, password = null) => {
            client = create(mode);
            try {
                await client.connect(endpointUrl);
                const identity = userName ? { type: ua.UserTokenType.UserName, userName, password } : {};
                session = await client.createSession(identity);
            } catch (error) {
                await client.disconnect();
                return error.message;
            }
            return null;
        },
        read: async (_, nodeId) => shown(await session.read({ nodeId })),
        start: async (...given) => {
            started = write(...given);
        },
        written: () => started,
    };
    for await (const line of readline.createInterface({ input: process.stdin })) {
        const [name, ...given] = line.split(" ");
        const answer = await commands[name](session, ...given);
        console.log("ok", JSON.stringify(answer ?? null));
    }
    await session.close();
    await client.disconnect();
}

main(...process.argv.slice(2));
