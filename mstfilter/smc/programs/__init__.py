"""Probabilistic programs: a model is a Python function that calls `sample` and `observe`.

>>> from mstfilter.smc import Normal, Program, observe, sample
>>> def ar1(previous, y):
...     x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
...     observe("y", Normal(x, 1.0), y)
>>> state, infos = Program(ar1).bootstrap(n=1000).run([0.3, -0.1, 0.8], seed=0)
>>> state.population.particles["x"].shape
(1000,)

The function runs once per step for all particles. `previous` is a mapping from names to arrays with one row per
particle; None at the first step. The new particles are also a mapping. The mapping has an array for each `sample`,
and for each entry of a mapping that the function returns. `observe` adds log p(value) to the log weights. None is a
missing value and adds nothing. A program may also contain:

- `switch(name, probs, branches, ...)` draws a branch for each particle and runs each branch on its particles;
- `per_particle` marks a function that runs once for every particle, so that the names may differ between particles.

The methods of `Program` make a bootstrap, a guided, an auxiliary and a resample-move filter from the function. The
guided filter needs a guide program that has the same sites. The lookahead of the auxiliary filter uses the mean or
mode instead of each draw. The resample-move filter makes Metropolis steps on all sites. `sample` and `observe` take
place in one pass. So a program is a Transition that weights its particles, and the filter has no Update.
"""
