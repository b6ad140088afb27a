"""Commands for many gateways: who runs what, and another file for one from afar."""
