"""Robot files (URDF, MJCF, meshes) and named scenes."""
