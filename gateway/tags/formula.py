"""Formulas: arithmetic on the values of other tags.

The calculation is decimal, so 0.1 + 0.2 is 0.3, and integers of 64 bits are exact.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Context, Decimal, DivisionByZero, InvalidOperation, Overflow

from gateway.values.numerals import Scalar, as_decimal

# A part of a formula: it is calculated from the values of the inputs, in their order.
Term = Callable[[Sequence[Decimal]], Decimal]

_EXACT = Context(prec=60, traps=[DivisionByZero, InvalidOperation, Overflow])
_SMALLEST, _LARGEST = -(2**63), 2**64 - 1
OPERATIONS: dict[str, Callable[[Decimal, Decimal], Decimal]] = {
    "+": _EXACT.add,
    "-": _EXACT.subtract,
    "*": _EXACT.multiply,
    "/": _EXACT.divide,
    "min": _EXACT.min,
    "max": _EXACT.max,
}
ONE_SIDED: dict[str, Callable[[Decimal], Decimal]] = {"-": _EXACT.minus, "abs": _EXACT.abs}


@dataclass(frozen=True, slots=True)
class Formula:
    """One calculation. `whole`: of whole numbers only, without a division."""

    text: str
    term: Term = field(compare=False)  # the text says it all
    whole: bool

    def value(self, inputs: Sequence[Scalar]) -> Scalar:
        """Returns the result for the values of the inputs; bits count 0 and 1.

        Raises `ArithmeticError` with a sentence where there is none.
        """
        try:
            result = self.term([as_decimal(value) for value in inputs])
        except (DivisionByZero, InvalidOperation):
            raise ArithmeticError("division by zero") from None
        except Overflow:
            raise ArithmeticError("the result is too large") from None
        if self.whole and _SMALLEST <= result <= _LARGEST:
            return int(result)
        number = float(result)
        if self.whole or not math.isfinite(number):
            raise ArithmeticError("the result is too large")
        return number
