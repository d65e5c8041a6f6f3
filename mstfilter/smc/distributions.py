"""Light distributions for models: drawn and weighed for all particles at once.

>>> import numpy as np
>>> rng = np.random.default_rng(0)
>>> x = Normal(np.zeros(5), 2.0).sample(rng, 5)          # one row a particle
>>> Normal(x, 1.0).log_prob(0.3).shape
(5,)

The first axis is the particles'. Parameters of shape () or (n,) give values (n,); parameters (1, d) or (n, d) give
values (n, d), whose entries are independent and whose log densities are summed. `log_prob` is always (n,), or a
number where nothing has rows. Frozen distributions of scipy.stats and objects of torch.distributions can be used
wherever one of these can; see `mstfilter.smc.adapters`. They are slower: a light one costs a third to a sixth.
"""

from __future__ import annotations

from mstfilter.smc.continuous import Gamma, MultivariateNormal, Normal, Student, Uniform
from mstfilter.smc.discrete import Bernoulli, Categorical, Poisson
from mstfilter.smc.distribution import Distribution

__all__ = [
    "Bernoulli",
    "Categorical",
    "Distribution",
    "Gamma",
    "MultivariateNormal",
    "Normal",
    "Poisson",
    "Student",
    "Uniform",
]
