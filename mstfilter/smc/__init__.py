"""The particle filter itself; knows nothing of images, voxels or robots."""
