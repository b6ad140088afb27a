"""The audit: writes, commands and acknowledgements, in a file that shows whether it was changed."""
