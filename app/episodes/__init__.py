"""Episodes as the app runs them: in the simulator, from an order to a folder of results."""
