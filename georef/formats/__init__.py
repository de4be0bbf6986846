"""Read and write file formats of the field: trajectories and point clouds. Functions take open files or bytes."""
