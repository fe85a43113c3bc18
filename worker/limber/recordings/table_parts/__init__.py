"""Further parts of other programs' tables: clocks, and titles of several rows."""
