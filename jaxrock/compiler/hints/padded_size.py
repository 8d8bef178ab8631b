"""Padded lengths of arrays: programs are compiled for few lengths only."""

_LEAST, _DOUBLED = 8, 4096  # the smallest length; up to the second one, lengths double


def padded_size(size: int) -> int:
    """Return a length with room for `size` elements, less than twice as many."""
    doubled = 1 << (max(size, _LEAST) - 1).bit_length()
    return doubled if size <= _DOUBLED else -(-size // (doubled // 8)) * (doubled // 8)
