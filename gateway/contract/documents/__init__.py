"""The shapes of all documents on Zenoh, as types: the code makes them, the schemas follow."""
