"""Text that is not ours, on its way to a terminal."""


def plain(text: str) -> str:
    """What a terminal would obey, or could not print, written as Python writes it."""
    return "".join(c if c.isprintable() or c == "\n" else repr(c)[1:-1] for c in text)
