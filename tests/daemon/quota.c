/* A quota for one process: the bytes that its files in a folder may hold together, on request.
   LD_PRELOAD=… QUOTA_OF=folder QUOTA_FILE=…, which contains the number; without the file there is no quota. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <ftw.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <unistd.h>

#define REAL(name) (real ? real : (real = dlsym(RTLD_NEXT, name)))

static __thread long long used;

static int add(const char *path, const struct stat64 *of, int kind, struct FTW *where) {
  (void)path, (void)where;
  if (kind == FTW_F) used += of->st_size;
  return 0;
}

static long long limit(void) {
  char said[32] = {0};
  const char *wanted = getenv("QUOTA_FILE");
  int asked = wanted ? open(wanted, O_RDONLY | O_CLOEXEC) : -1;
  if (asked < 0) return -1;
  if (read(asked, said, sizeof said - 1) < 1) said[0] = 0;
  close(asked);
  return said[0] ? atoll(said) : -1;
}

/* Return how many of n bytes at `at` may be written: only growth counts, and a part may fit. */
static long long allowed(int file, long long at, long long n) {
  char link[64], path[4096] = {0};
  const char *of = getenv("QUOTA_OF");
  struct stat64 now;
  int kept = errno;
  long long most = limit(), fits = n;
  snprintf(link, sizeof link, "/proc/self/fd/%d", file);
  if (of && most >= 0 && readlink(link, path, sizeof path - 1) > 0 &&
      !strncmp(path, of, strlen(of)) && path[strlen(of)] == '/' && !fstat64(file, &now) &&
      S_ISREG(now.st_mode) && at + n > now.st_size) {
    used = 0;
    nftw64(of, add, 8, FTW_PHYS);
    long long inside = now.st_size > at ? now.st_size - at : 0, free = most - used;
    long long grown = at > now.st_size ? at - now.st_size : 0; /* a hole counts, too */
    fits = free > grown ? inside + free - grown : inside;
    if (fits > n) fits = n;
  }
  errno = kept;
  if (fits < 1 && n > 0) errno = EDQUOT;
  return fits;
}

ssize_t pwrite64(int file, const void *data, size_t n, off64_t at) {
  static ssize_t (*real)(int, const void *, size_t, off64_t);
  long long fits = allowed(file, at, n);
  return fits < 1 && n ? -1 : REAL("pwrite64")(file, data, fits, at);
}

ssize_t pwrite(int file, const void *data, size_t n, off_t at) { return pwrite64(file, data, n, at); }

ssize_t write(int file, const void *data, size_t n) {
  static ssize_t (*real)(int, const void *, size_t);
  off64_t at = fcntl(file, F_GETFL) & O_APPEND ? lseek64(file, 0, SEEK_END) : lseek64(file, 0, SEEK_CUR);
  long long fits = at < 0 ? (long long)n : allowed(file, at, n);
  return fits < 1 && n ? -1 : REAL("write")(file, data, fits);
}

static int grows(int file, off64_t to) {
  struct stat64 now;
  if (fstat64(file, &now) || to <= now.st_size) return 1;
  if (allowed(file, now.st_size, to - now.st_size) == to - now.st_size) return 1;
  errno = EDQUOT;
  return 0;
}

int ftruncate64(int file, off64_t to) {
  static int (*real)(int, off64_t);
  return grows(file, to) ? REAL("ftruncate64")(file, to) : -1;
}

int ftruncate(int file, off_t to) { return ftruncate64(file, to); }

int posix_fallocate64(int file, off64_t at, off64_t n) {
  static int (*real)(int, off64_t, off64_t);
  return grows(file, at + n) ? REAL("posix_fallocate64")(file, at, n) : EDQUOT;
}

int posix_fallocate(int file, off_t at, off_t n) { return posix_fallocate64(file, at, n); }

/* With delayed allocation, the flush fails as long as nothing fits. */
static int flushes(int file) {
  const char *late = getenv("QUOTA_LATE");
  struct stat64 now;
  if (!late || fstat64(file, &now) || !S_ISREG(now.st_mode)) return 1;
  return allowed(file, now.st_size, 1) == 1;
}

int fsync(int file) {
  static int (*real)(int);
  return flushes(file) ? REAL("fsync")(file) : -1;
}

int fdatasync(int file) {
  static int (*real)(int);
  return flushes(file) ? REAL("fdatasync")(file) : -1;
}
