"""Commands that use a line without a gateway: scan, peek, record, replay."""
