"""An edge node of Sparkplug B 3.0: a device of a gateway is a device, a tag is a metric."""
