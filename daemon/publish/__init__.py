"""Messages to subscribers, questions of peers, their keys, and the process with the sockets."""


class PublishError(Exception):
    """An endpoint cannot be opened or served, or has no subscriber."""

    taken: str | None = None
    """`tcp://` endpoint that is in use by another program; None: the error has another cause."""
