"""Edit the skeleton: its nodes in the view, the operators, the part of its panel."""
