"""The contract with users, on Zenoh, HTTP and the command line: keys, documents, rights."""
