"""A world, a cost, a planner and an estimator for `osf episode`, in a package of their own."""
