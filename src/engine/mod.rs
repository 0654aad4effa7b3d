//! The seam to the tensor library: device, precision, fused operations, parameter files.
