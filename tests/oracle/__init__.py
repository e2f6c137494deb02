"""An independent oracle: the estimators from their definitions, in numpy and scipy.

Nothing here imports from jaxcal; a problem is handed over as plain arrays. Everything is dense and
slow on purpose: Jacobians by complex steps, all offsets as unknowns where the definition has them,
determinants and inverses of whole matrices, quadratures image by image.
"""
