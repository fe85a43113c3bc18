"""What tables of other programs need beside their numbers: clocks, and titles of several rows."""
