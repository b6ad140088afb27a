"""The features of tags: each module says its settings, its checks, and what clients see of it."""
