"""Real processes, real kills, real cables pulled out."""
