"""What users see, on Zenoh, HTTP and the command line: keys, documents, rights."""
