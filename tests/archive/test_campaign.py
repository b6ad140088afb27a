"""A seeded slice of the campaign `make archive`."""

from tests.archive.campaign import campaign


def test_kills_at_random_moments_lose_and_double_nothing() -> None:
    assert campaign("postgres", 4, seed=3) > 100
