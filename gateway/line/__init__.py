"""A line asks its engine, performs one transaction on the port, and reports the result."""
