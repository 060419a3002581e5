/* A disk that fails beneath a database, for one process: input/output errors on request.
   LD_PRELOAD=… DISK_ERROR_OF=database DISK_ERROR_FILE=…, which contains `write` or `sync`. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

static int fails(int file, const char *what) {
  char link[64], path[4096] = {0}, said[16] = {0};
  const char *of = getenv("DISK_ERROR_OF"), *wanted = getenv("DISK_ERROR_FILE");
  int kept = errno, asked = wanted ? open(wanted, O_RDONLY | O_CLOEXEC) : -1;
  if (asked >= 0) {
    if (read(asked, said, sizeof said - 1) < 0) said[0] = 0;
    close(asked);
  }
  errno = kept;
  if (!of || strcmp(said, what)) return 0;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  if (readlink(link, path, sizeof path - 1) < 0 || strncmp(path, of, strlen(of))) return 0;
  if (path[strlen(of)] && path[strlen(of)] != '-') return 0; /* neither the file nor its log */
  errno = EIO;
  return 1;
}

#define REAL(name) (real ? real : (real = dlsym(RTLD_NEXT, name)))

ssize_t pwrite64(int file, const void *data, size_t n, off64_t at) {
  static ssize_t (*real)(int, const void *, size_t, off64_t);
  return fails(file, "write") ? -1 : REAL("pwrite64")(file, data, n, at);
}

ssize_t pwrite(int file, const void *data, size_t n, off_t at) {
  return pwrite64(file, data, n, at);
}

ssize_t write(int file, const void *data, size_t n) {
  static ssize_t (*real)(int, const void *, size_t);
  return fails(file, "write") ? -1 : REAL("write")(file, data, n);
}

int fdatasync(int file) {
  static int (*real)(int);
  return fails(file, "sync") ? -1 : REAL("fdatasync")(file);
}

int fsync(int file) {
  static int (*real)(int);
  return fails(file, "sync") ? -1 : REAL("fsync")(file);
}
