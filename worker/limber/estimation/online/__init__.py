"""Estimates while a pull is going on."""
