"""The section `transfers`: rows from one PLC to another, and the tags that they need."""
