"""Checks of the exercises: each prints one sentence."""

from collections.abc import Callable
from typing import Any


def check(number: int, answer: Any, is_right: Callable[[Any], Any], hint: str) -> None:
    """Print whether the answer to an exercise is right.

    Args:
        number: Number of the exercise.
        answer: The answer; `...` as long as there is none.
        is_right: Returns whether an answer is right.
        hint: What to think of if it is wrong.
    """
    if answer is ...:
        print(f"Exercise {number}: not solved yet. Replace the dots, and run both cells again.")
        return
    try:
        right = bool(is_right(answer))
    except Exception as error:
        print(f"Exercise {number}: not yet ({type(error).__name__}: {error}). {hint}")
        return
    print(f"Exercise {number}: right." if right else f"Exercise {number}: not yet. {hint}")
