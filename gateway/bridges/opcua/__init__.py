"""The OPC UA server with the values of the gateways."""
