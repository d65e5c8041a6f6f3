"""RGB-D geometry: cameras, frames, clips, voxel grids, hypotheses, recordings. Knows nothing of filters."""
