"""The sequential parameter identification of Beadle et al. (spring-suspended table), a peer of maximum likelihood.

`published` holds the tests and values that the source prints, `data` measured or simulated transfer functions,
`problem` their residuals and derivatives, `fit` the scheme itself; `python -m benchmarks.sequential` prints it beside
the source's tables. No command of avis_ctrl uses it.
"""
