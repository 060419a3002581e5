/* A wall clock that others set: CLOCK_REALTIME plus the seconds in a file, for one process.
   LD_PRELOAD=… CLOCK_OFFSET_FILE=…  The monotonic clock and the kernel's timers are left alone. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/time.h>
#include <sys/timex.h>
#include <time.h>
#include <unistd.h>

static long offset_s(void) {
  static int file = -1;
  const char *path = file < 0 ? getenv("CLOCK_OFFSET_FILE") : NULL;
  char text[32] = {0};
  if (path) file = open(path, O_RDONLY | O_CLOEXEC);
  if (file < 0 || pread(file, text, sizeof text - 1, 0) <= 0) return 0;
  return atol(text);
}

int clock_gettime(clockid_t clock, struct timespec *now) {
  static int (*real)(clockid_t, struct timespec *);
  if (!real) real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
  int done = real(clock, now);
  if (!done && (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE)) now->tv_sec += offset_s();
  return done;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone) {
  struct timespec precise;
  (void)zone;
  int done = clock_gettime(CLOCK_REALTIME, &precise);
  now->tv_sec = precise.tv_sec;
  now->tv_usec = precise.tv_nsec / 1000;
  return done;
}

time_t time(time_t *where) {
  struct timespec now;
  clock_gettime(CLOCK_REALTIME, &now);
  if (where) *where = now.tv_sec;
  return now.tv_sec;
}

/* The kernel reports a synchronised clock, if CLOCK_SYNCHRONISED is set. */
int adjtimex(struct timex *state) {
  static int (*real)(struct timex *);
  if (!real) real = (int (*)(struct timex *))dlsym(RTLD_NEXT, "adjtimex");
  int done = real(state);
  if (getenv("CLOCK_SYNCHRONISED")) {
    return TIME_OK;
  }
  return done;
}
