//! The lens of a recording.

use super::manifest::LensEntry;
use crate::formats::ReadError;
use crate::formats::read_error::Position;
use crate::geometry::camera::{Camera, Fisheye624, KannalaBrandt, Lens, Pinhole, Rational};
use std::path::Path;

pub(super) fn lens_of(path: &Path, entry: &LensEntry) -> Result<Camera, ReadError> {
    let wrong = || {
        ReadError::malformed(
            path,
            Position::File,
            "`lens` has parameters that are no lens",
        )
    };
    let (lens, [width, height]) = match entry {
        LensEntry::Pinhole {
            parameters: [fx, fy, cx, cy],
            size,
        } => (
            Lens::Pinhole(Pinhole {
                fx: *fx,
                fy: *fy,
                cx: *cx,
                cy: *cy,
            }),
            *size,
        ),
        LensEntry::KannalaBrandt {
            parameters: [fx, fy, cx, cy, radial @ ..],
            size,
        } => (
            Lens::KannalaBrandt(KannalaBrandt {
                fx: *fx,
                fy: *fy,
                cx: *cx,
                cy: *cy,
                radial: *radial,
            }),
            *size,
        ),
        LensEntry::Rational {
            parameters: [fx, fy, cx, cy, distortion @ ..],
            size,
        } => (
            Lens::Rational(Rational {
                fx: *fx,
                fy: *fy,
                cx: *cx,
                cy: *cy,
                distortion: *distortion,
            }),
            *size,
        ),
        LensEntry::Fisheye624 { parameters, size } => (
            Lens::Fisheye624(Fisheye624::from_parameters(parameters).ok_or_else(wrong)?),
            *size,
        ),
    };
    let parameters_ok = match &lens {
        Lens::Pinhole(Pinhole { fx, fy, .. })
        | Lens::KannalaBrandt(KannalaBrandt { fx, fy, .. })
        | Lens::Rational(Rational { fx, fy, .. }) => *fx > 0.0 && *fy > 0.0,
        Lens::Fisheye624(_) => true,
    };
    if !parameters_ok || width == 0 || height == 0 {
        return Err(wrong());
    }
    Ok(Camera {
        lens,
        width,
        height,
        valid_radius: None,
    })
}
