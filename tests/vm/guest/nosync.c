/* LD_PRELOAD for the recorder: says "durable" and does nothing, the control of the power cuts. */
#include <stddef.h>

int fsync(int fd) { return fd < 0; }
int fdatasync(int fd) { return fd < 0; }
int sync_file_range(int fd, long offset, long bytes, unsigned flags) { return fd < 0 && offset && bytes && flags; }
