"""Forward simulations of a pull: quasi-static, dynamic, hung load, reduced."""
