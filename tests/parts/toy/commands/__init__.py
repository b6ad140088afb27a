"""The commands of the toy part."""
