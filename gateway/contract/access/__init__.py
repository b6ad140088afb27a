"""Who may do what: secrets, signatures, certificates."""
