"""Names of results' types as an operator reads them."""


def words(type_name: str) -> str:
    """Write a type's name as words.

    Examples
    --------
    >>> words("TableHomography"), words("Ramp")
    ('Table homography', 'Ramp')
    """
    spaced = "".join(f" {c.lower()}" if c.isupper() else c for c in type_name).strip()
    return spaced[:1].upper() + spaced[1:]
