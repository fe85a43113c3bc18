/* Loads built libraries and checks one kernel of each: scripts/release runs it in an emulator. */
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#ifdef _WIN32
#include <windows.h>
#define OPEN(path) (void*)LoadLibraryA(path)
#define FIND(library, name) (void*)GetProcAddress(library, name)
#else
#include <dlfcn.h>
#define OPEN(path) dlopen(path, RTLD_NOW)
#define FIND(library, name) dlsym(library, name)
#endif

typedef void (*Product)(const int32_t*, const int32_t*, const double*, const double*, double*,
                        int64_t, int64_t, int64_t, int64_t);

int main(int count, char** paths) {
  /* [[2, .5], [0, -1]] times the rows [1, 2, 3] and [4, 5, 6]. */
  const int32_t starts[] = {0, 2, 3}, columns[] = {0, 1, 1};
  const double values[] = {2, .5, -1}, field[] = {1, 2, 3, 4, 5, 6}, right[] = {4, 6.5, 9, -4, -5, -6};
  for (int k = 1; k < count; ++k) {
    double product[6] = {0};
    void* library = OPEN(paths[k]);
    Product sparse_times = library ? (Product)FIND(library, "sparse_times") : NULL;
    if (sparse_times) sparse_times(starts, columns, values, field, product, 3, 3, 2, 2);
    const int is_right = !memcmp(product, right, sizeof right);
    printf("%s: %s\n", paths[k], is_right ? "right" : library ? "wrong" : "does not load");
    if (!is_right) return 1;
  }
  return 0;
}
