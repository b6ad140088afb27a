"""Questions of the past and their answers, on Zenoh and HTTP alike."""
