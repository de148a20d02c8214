"""The daemon: scene, judge, publisher, service loop, command line."""


def version() -> str:
    """Return the version of the installation; `0.0`: this code was copied, not installed."""
    from importlib import metadata  # takes ten milliseconds

    try:
        return metadata.version("graspd")
    except metadata.PackageNotFoundError:
        return "0.0"
