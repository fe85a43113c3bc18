"""The certificate: a proven lower bound on the cost of every path on a field."""
