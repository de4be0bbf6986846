"""Files of the field, read and written: trajectories and point clouds. Functions take open files or bytes."""
