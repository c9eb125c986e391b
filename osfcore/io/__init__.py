"""File formats with their checks: scenes, states, observations, image sets, pushes, rollouts, images."""
