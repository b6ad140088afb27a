"""YAML files: text to plain data that knows its lines, and back."""
