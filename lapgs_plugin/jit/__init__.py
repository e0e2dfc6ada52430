"""Compile and run the CPU kernels with Numba. Four things that Numba leaves out have a module each:

- Vectors (`lanes`; `lowering` teaches them to Numba by `numba.extending`). LLVM vectorises the loops that it fully
  understands and silently leaves the others scalar: blending, with its early exits and its skipped blocks, is one of
  them. Numba's `@vectorize` makes functions of whole arrays, so that all pixels would go through memory for each splat.
  `lanes` also reads arrays without reference counts, which Numba counts atomically, and has the atomic counter that
  threads take tasks from.
- Threads (`threads`). `prange` deals out equal numbers of tiles, of which some take many times as long as others. Its
  thread pools end the process if two Python threads use them at once (workqueue) or if it has been forked (GNU OpenMP),
  or are another package (TBB). `concurrent.futures` takes longer to start a kernel on many threads than a small
  image's kernel runs.
- Memory (`buffers`). Neither NumPy nor PyTorch keeps large blocks on the CPU, and the system clears new ones page by
  page.
- A cache that is safe to edit beside, and a message while the user waits (`compiler`). Numba's own cache looks at a
  function's file alone: after a change of a helper in another file it would run the old code.
"""
