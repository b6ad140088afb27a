"""The real program under attack: hostile peers, broken networks, mistakes of the user."""
