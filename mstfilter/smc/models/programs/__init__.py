"""Probabilistic programs: a model is a Python function that calls `sample` and `observe`.

>>> from mstfilter.smc import Normal, Program, observe, sample
>>> def ar1(previous, y):
...     x = sample("x", Normal(0.0, 1.0) if previous is None else Normal(0.9 * previous["x"], 0.5))
...     observe("y", Normal(x, 1.0), y)
>>> sites, ys = Program(ar1).simulate(50, seed=1)
>>> state, infos = Program(ar1).bootstrap(n=1000).run(ys, seed=0)
>>> state.population.particles["x"].shape
(1000,)

The function runs once per step for all particles. `previous` is a mapping from names to arrays with one row per
particle, None at the first step. The new particles are also a mapping of arrays: one array for each `sample`, and one
for each entry of a mapping that the function returns. `observe` adds log p(value) to the log weights; a value of None
(missing) has no effect. ``switch(name, probs, branches, ...)`` draws a branch for each particle and runs each branch
on its particles. For particles with different numbers of variables, use a `StateSpaceModel` of objects.

The methods of `Program` make a bootstrap filter or a guided filter from the function. A guided filter needs a guide:
a program that samples the same names, or some of them. A run of the program moves and weights the particles. The
program is therefore the transition of the filter, and the filter has no update.
"""
