"""Small types of several floors, on the ground floor."""

from __future__ import annotations


class EventName(str):
    """Name of an event that says in words of its own what happened.

    A block declares what it watches by such a name; of a plain name it is said
    that the signal left its limits.

    Parameters
    ----------
    name : str
        The name.
    words : str, optional
        What is said of it, as "was at its limit" of an actuator; empty where
        the name is itself a condition, as "goal out of reach".
    """

    words: str

    def __new__(cls, name: str, words: str = "") -> EventName:
        """Name with its words."""
        self = super().__new__(cls, name)
        self.words = words
        return self
