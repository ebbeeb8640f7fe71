"""Numbers of things in messages."""


def counted(number: int, noun: str) -> str:
    """Return a number of things in words: "1 fall", "2,000 falls"."""
    return f"{number:,} {noun}{'' if number == 1 else 's'}"
