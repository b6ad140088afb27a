"""Commands for certificates: the authority of a plant, and gateways that enrol with a code."""
