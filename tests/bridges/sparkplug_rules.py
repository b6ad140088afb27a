"""The normative rules of Sparkplug 3.0 about an edge node: how each is checked.

The names are those of the specification (`tck-id-…`) without their beginning; `*` stands for all
kinds of message that have a rule of this name. Rules about hosts, templates and data sets are left
out: the bridge is no host and sends none.
"""

BY_HOST = {  # a check of `sparkplug_host.CHECKS`, for every message
    "the topic has its form": (
        "topic-structure topic-structure-namespace-a topics-*-topic"
        " topic-structure-namespace-device-id-associated-message-types"
        " topic-structure-namespace-device-id-non-associated-message-types"
        " message-flow-*-topic message-flow-device-birth-publish-dbirth-match-edge-node-topic"
    ),
    "its payload is of protobuf, and has a time": (
        "topics-*-timestamp payloads-*-timestamp payloads-timestamp-in-UTC message-flow-*-payload"
        " payloads-metric-timestamp-in-UTC"
    ),
    "QoS 0, not retained": (
        "topics-*-mqtt payloads-*-qos payloads-*-retain message-flow-*-birth-qos"
        " message-flow-*-birth-retained"
    ),
    "the death has QoS 1, not retained": (
        "payloads-ndeath-will-message-qos payloads-ndeath-will-message-retain"
        " message-flow-edge-node-birth-publish-will-message-qos"
        " message-flow-edge-node-birth-publish-will-message-will-retained"
    ),
    "the birth has the number 0": (
        "topics-nbirth-seq-num payloads-nbirth-seq payloads-sequence-num-req-nbirth"
        " message-flow-edge-node-birth-publish-nbirth-payload-seq"
    ),
    "each number follows the last": (
        "topics-*-seq-num topics-dbirth-seq payloads-*-seq payloads-*-seq-inc"
        " payloads-ddeath-seq-number payloads-sequence-num-always-included"
        " payloads-sequence-num-incrementing"
        " message-flow-device-birth-publish-dbirth-payload-seq"
    ),
    "the death has bdSeq and nothing else": (
        "topics-ndeath-payload topics-ndeath-seq payloads-ndeath-seq"
    ),
    "the death has the bdSeq of the birth": (
        "topics-nbirth-bdseq-matching payloads-nbirth-bdseq-repeat payloads-ndeath-bdseq"
        " operational-behavior-data-commands-rebirth-action-3"
    ),
    "bdSeq is an Int64, in 0 to 255": (
        "topics-nbirth-bdseq-included payloads-nbirth-bdseq"
        " message-flow-edge-node-birth-publish-nbirth-payload-bdSeq"
        " message-flow-edge-node-birth-publish-will-message-payload-bdSeq"
    ),
    "the node control is a Boolean without alias": (
        "topics-nbirth-rebirth-metric payloads-nbirth-rebirth-req"
        " operational-behavior-data-commands-rebirth-name"
        " operational-behavior-data-commands-rebirth-name-aliases"
        " operational-behavior-data-commands-rebirth-datatype"
        " operational-behavior-data-commands-rebirth-value"
    ),
    "a birth has name, type, time and value of each metric": (
        "topics-*-metrics payloads-name-requirement payloads-name-birth-data-requirement"
        " payloads-metric-datatype-req operational-behavior-data-publish-*-values"
    ),
    "a device's birth has aliases, unique in the node": (
        "payloads-alias-uniqueness payloads-alias-birth-requirement"
    ),
    "data has the alias of a birth, and no name or type": (
        "topics-*-metric-reqs operational-behavior-data-publish-nbirth"
        " operational-behavior-data-publish-dbirth payloads-alias-data-cmd-requirement"
        " payloads-metric-datatype-not-req"
    ),
    "data has time and value of each metric": "topics-ddata-payload",
    "a type is one of the list": (
        "payloads-metric-datatype-value payloads-metric-datatype-value-type"
        " payloads-metric-propertyvalue-type-value payloads-metric-propertyvalue-type-type"
    ),
    "metrics are in the order of time": "operational-behavior-data-publish-*-order",
    "properties have as many keys as values, with types": (
        "payloads-propertyset-keys-array-size payloads-propertyset-values-array-size"
        " payloads-metric-propertyvalue-type-req"
    ),
    "the quality is an Int32 of the list": (
        "payloads-propertyset-quality-value-type payloads-propertyset-quality-value-value"
    ),
    "a node is born before its devices, and these before data": (
        "principles-birth-certificates-order payloads-*-order"
        " message-flow-device-birth-publish-nbirth-wait"
        " message-flow-edge-node-birth-publish-connect"
    ),
    "data has only what changed": (
        "principles-rbe-recommended operational-behavior-data-publish-*-change"
    ),
}
BY_TEST = {  # a step of tests/bridges/test_sparkplug.py
    "the broker's log of the connection": (
        "principles-persistence-clean-session-311 payloads-ndeath-will-message"
        " message-flow-edge-node-birth-publish-will-message"
    ),
    "bdSeq counts the connections": "topics-nbirth-bdseq-increment",
    "subscriptions have QoS 1": (
        "message-flow-edge-node-ncmd-subscribe message-flow-device-dcmd-subscribe"
    ),
    "a rebirth": (
        "operational-behavior-data-commands-rebirth-action-1"
        " operational-behavior-data-commands-rebirth-action-2"
        " operational-behavior-data-commands-ncmd-rebirth-verb"
        " operational-behavior-data-commands-ncmd-rebirth-name"
        " operational-behavior-data-commands-ncmd-rebirth-value"
    ),
    "a device that does not answer": "operational-behavior-device-ddeath",
    "an end that is meant": (
        "operational-behavior-edge-node-intentional-disconnect-ndeath"
        " operational-behavior-edge-node-intentional-disconnect-packet"
        " payloads-ndeath-will-message-publisher"
        " payloads-ndeath-will-message-publisher-disconnect-mqtt311"
    ),
    "the primary host": (
        "message-flow-edge-node-birth-publish-phid-*"
        " operational-behavior-edge-node-termination-host-offline"
        " operational-behavior-edge-node-termination-host-offline-reconnect"
        " operational-behavior-edge-node-termination-host-offline-timestamp"
        " operational-behavior-edge-node-birth-sequence-wait"
        " operational-behavior-primary-application-state-with-multiple-servers-*"
    ),
    "ids with + / # are refused": "topic-structure-namespace-valid-*",
}
NOT_CHECKED = {
    "topic-structure-namespace-unique-*": "only a person can give each node an id of its own",
    "topic-structure-namespace-duplicate-device-id-across-edge-node": "a permission",
    "payloads-nbirth-edge-node-descriptor": "as unique-*",
    "case-sensitivity-*": "the gateway has `Speed` and `speed`, if the file has both",
    "principles-persistence-clean-session-50": "the bridge speaks MQTT 3.1.1 with Sparkplug",
    "payloads-ndeath-will-message-publisher-disconnect-mqtt50": "the same",
    "topics-ndata-payload": "the node has no metric that changes: NDATA is never sent",
    "topics-nbirth-templates": "there are no templates",
    "payloads-name-cmd-requirement": "a permission",
}
