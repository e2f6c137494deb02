"""Diagnostics of an answer, computed with numpy on the host when somebody reads them.

    image_errors     every image's errors and their derivatives; the rest is computed from these
    influence        what leaving out each image would change, and what the residuals say of it
    uncertainty      offsets' SDs, weakest direction, what is known from the prior alone
    residual_checks  images that stand out, the fit of the noise model, which poses to add
    sd_by_place      how the SD of an error depends on the target's place in the image
    frame_checks     wrong frames or units
    wrong_angles     rotations as they would be if their angles had been read in another way
    unmodelled       errors that the model leaves out and that the residuals show
    tracker_distortion   one of these: tracked positions that are off, smoothly in space
    second_target    another one: images of two targets, or with two origins
    clipped          points that were cut off at the edge of a region
    change_point     where something has changed at once
    serial_errors    errors that are alike in successive images
    channel_points   what the elements' times of flight say of their images' points
    gaussian_offsets   the fit with Gaussian offsets, beside offsets with sharp limits
    outlier_agreement   whether the images left out agree on another calibration
    diagnose         uncertainty and residual_checks, for a calibration or a batch
    directions, misfits, outliers, offset_fit   the same in words
    warnings         everything that a person should know before using an answer
    intervals        confidence intervals and target registration error
    metrics          reconstruction precision, reproducibility
    comparison       whether two calibrations of one probe agree

A solve itself leaves X, target, offsets, SDs, covariance and status
(:mod:`jaxcal.calibration.answer`).
"""
