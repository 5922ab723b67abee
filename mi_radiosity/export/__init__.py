"""A solution taken home: measured, and exported for those who have nothing of this package."""
