"""The `greet` command."""

from pathlib import Path

from gateway.config import load
from tests.parts.toy.settings import ToySection


def greet(file: Path) -> None:
    """Print the greeting of the file."""
    toy = load(file).part(ToySection)
    print("nobody greets" if toy is None else toy.greeting)
