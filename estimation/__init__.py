"""What pictures say about inclusions: features now, mapping and estimators later."""

from estimation.scalars import scalars

__all__ = ["scalars"]
