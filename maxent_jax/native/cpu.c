/* Tells which builds of the library this processor can run. Compiled for the oldest processors of
   its architecture, so that it runs anywhere, before any other build is loaded. */

/* The x86-64 level of the build to load: 4 (AVX-512), 3 (AVX2), or 0 if neither can run; 8 on
   64-bit Arm. */
int maxent_level(void) {
#if defined(__x86_64__)
  __builtin_cpu_init(); /* also checks that the system saves the wide registers */
  if (!(__builtin_cpu_supports("avx2") && __builtin_cpu_supports("fma") &&
        __builtin_cpu_supports("bmi") && __builtin_cpu_supports("bmi2") &&
        __builtin_cpu_supports("popcnt")))
    return 0;
  if (__builtin_cpu_supports("avx512f") && __builtin_cpu_supports("avx512vl") &&
      __builtin_cpu_supports("avx512bw") && __builtin_cpu_supports("avx512dq") &&
      __builtin_cpu_supports("avx512cd"))
    return 4;
  return 3;
#elif defined(__aarch64__)
  return 8;
#else
  return 0;
#endif
}
