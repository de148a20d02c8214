"""Messages, sockets, the process that holds these, questions of peers, and keys."""


class PublishError(Exception):
    """An endpoint cannot be opened, or its thread has ended."""

    taken: str | None = None
    """Endpoint that is in use by another program; None: the error has another cause."""
