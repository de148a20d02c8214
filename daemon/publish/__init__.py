"""Messages, sockets and the process that has them, questions, keys."""


class PublishError(Exception):
    """An endpoint cannot be opened, or its thread has ended."""

    taken: str | None = None
    """Endpoint that another program uses; None: the error has another cause."""
