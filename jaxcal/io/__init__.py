"""Files in and out. What is read is not trusted; what is written is complete or absent.

=================== ==========================================================================
recordings          ``hdf5`` (jaxcal's own), ``text`` (``table``, ``columns``, ``lines``)
tracked sequences   ``sequence`` (the type), ``sequence_files`` (``metaimage``, ``nrrd``,
                    ``sequence_header``, ``pixel_stream``), ``trackers`` (NDI, Motive),
                    ``tus_rec``
pixels              ``png``, ``grey``, ``dicom`` (the size of a pixel)
points              ``slicer`` (markups), ``picker`` (placed by hand)
imports             ``importing`` (recordings from other programs' files), ``folder`` (PNG)
transforms          ``itk`` (Slicer), ``plus`` (configurations, fCal), ``ros``, ``tus_rec``
connections         ``openigtlink`` (messages), ``message_content``, ``tracked_frame``,
                    ``serving`` (to Slicer), ``plus_server``
what all need       ``untrusted`` and ``heap`` (HDF5), ``xml``, ``toml``, ``given_files``,
                    ``frame_names``, ``atomic``, ``outputs``
=================== ==========================================================================

Nothing here imports JAX. Units are mm, px and s; another unit in a file is converted at once.
"""
