"""Taking it home: solutions and view factors in the formats of other programs."""
