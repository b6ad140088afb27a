"""Seeded slices of the campaign `make archive`."""

import pytest

from tests.archive.campaign import campaign


@pytest.mark.parametrize(("store", "kills"), [("postgres", 4), ("s3", 2), ("influx", 2)])
def test_kills_at_random_moments_lose_and_double_nothing(store: str, kills: int) -> None:
    assert campaign(store, kills, seed=3) > 50
