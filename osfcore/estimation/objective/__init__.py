"""What estimation minimises: parameters, observed views, photometric and masked losses."""
