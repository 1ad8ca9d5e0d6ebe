"""Errors of the flatness analysis."""


class NotFlatError(ValueError):
    """A plant is not flat for the given outputs; the message says why.

    Attributes
    ----------
    internal : int
        Dimension of the internal dynamics that the outputs do not determine; 0 if
        the outputs depend on each other.
    """

    def __init__(self, message: str, internal: int = 0) -> None:
        super().__init__(message)
        self.internal = internal
