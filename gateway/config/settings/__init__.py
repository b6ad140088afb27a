"""The settings of the file: types, sections, checked records."""
