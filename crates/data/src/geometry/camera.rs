//! Camera models: how a point in front of a camera becomes a pixel, and back.
//!
//! Axes are `OpenCV`'s (x right, y down, z forward); the centre of the top-left pixel is (0, 0). Three models cover most head-mounted
//! recordings: the pinhole, Project Aria's and Quest's Fisheye624 (radial, tangential and thin-prism terms; the "FisheyeRadTanThinPrism"
//! of the public `projectaria_tools`) and Kannala-Brandt with four radial terms (`OpenCV`'s fisheye, GoPro calibrations). A fourth,
//! `OpenCV`'s rational model, is for wide pinhole lenses (ARCTIC).

use nalgebra::{Matrix2, Vector2, Vector3};

/// Newton's method on these smooth, nearly linear functions needs four or five steps; more means that it will not converge.
const MAX_STEPS: usize = 50;
/// Convergence, in normalised image units: a ten-thousandth of a pixel at a focal length of 1000.
const TOLERANCE: f64 = 1e-9;

/// A lens on a pixel grid.
#[derive(Debug, Clone, PartialEq)]
pub struct Camera {
    /// How rays become points of the grid; its centre and focal lengths are in pixels of this image.
    pub lens: Lens,
    /// Pixels.
    pub width: u32,
    /// Pixels.
    pub height: u32,
    /// Pixels farther than this from the principal point carry no image (the corners of a fisheye).
    pub valid_radius: Option<f64>,
}

/// The projection itself.
#[derive(Debug, Clone, PartialEq)]
pub enum Lens {
    /// Without distortion.
    Pinhole(Pinhole),
    /// The fisheye of Project Aria and Quest.
    Fisheye624(Fisheye624),
    /// `OpenCV`'s fisheye model.
    KannalaBrandt(KannalaBrandt),
    /// `OpenCV`'s rational model, for wide lenses that are close to a pinhole.
    Rational(Rational),
}

/// `u = fx x/z + cx`, `v = fy y/z + cy`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pinhole {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Column of the principal point, pixels.
    pub cx: f64,
    /// Row of the principal point, pixels.
    pub cy: f64,
}

/// Six radial, two tangential and four thin-prism terms around the equidistant projection.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Fisheye624 {
    /// Focal length along x, pixels (per radian near the axis).
    pub fx: f64,
    /// Focal length along y, pixels (per radian near the axis).
    pub fy: f64,
    /// Column of the principal point, pixels.
    pub cx: f64,
    /// Row of the principal point, pixels.
    pub cy: f64,
    /// `k0` to `k5`: factors of the angle's powers 3, 5, ..., 13, radians.
    pub radial: [f64; 6],
    /// `p0` and `p1`.
    pub tangential: [f64; 2],
    /// `s0` to `s3`: of the squared and the fourth power of the radius, first along x, then along y.
    pub prism: [f64; 4],
}

/// Four radial terms around the equidistant projection; serves fields of view beyond 180 degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct KannalaBrandt {
    /// Focal length along x, pixels (per radian near the axis).
    pub fx: f64,
    /// Focal length along y, pixels (per radian near the axis).
    pub fy: f64,
    /// Column of the principal point, pixels.
    pub cx: f64,
    /// Row of the principal point, pixels.
    pub cy: f64,
    /// `k1` to `k4` of `OpenCV`: factors of the angle's powers 3, 5, 7 and 9, radians.
    pub radial: [f64; 4],
}

/// `OpenCV`'s eight distortion terms `k1 k2 p1 p2 k3 k4 k5 k6` around a pinhole.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Rational {
    /// Focal length along x, pixels.
    pub fx: f64,
    /// Focal length along y, pixels.
    pub fy: f64,
    /// Column of the principal point, pixels.
    pub cx: f64,
    /// Row of the principal point, pixels.
    pub cy: f64,
    /// In `OpenCV`'s order.
    pub distortion: [f64; 8],
}

impl Camera {
    /// The pixel of a point in the camera frame. `None` where the model does not reach: behind the camera, or not finite.
    /// The pixel may lie outside of the image; [`Camera::sees`] tells.
    #[must_use]
    pub fn project(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        let pixel = match &self.lens {
            Lens::Pinhole(lens) => lens.project(point),
            Lens::Fisheye624(lens) => lens.project(point),
            Lens::KannalaBrandt(lens) => lens.project(point),
            Lens::Rational(lens) => lens.project(point),
        }?;
        (pixel.x.is_finite() && pixel.y.is_finite()).then_some(pixel)
    }

    /// The ray of a pixel, scaled to z = 1. `None` where the model cannot be inverted or the ray does not point forward.
    #[must_use]
    pub fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        let ray = match &self.lens {
            Lens::Pinhole(lens) => Some(lens.unproject(pixel)),
            Lens::Fisheye624(lens) => lens.unproject(pixel),
            Lens::KannalaBrandt(lens) => lens.unproject(pixel),
            Lens::Rational(lens) => lens.unproject(pixel),
        }?;
        (ray.x.is_finite() && ray.y.is_finite()).then_some(ray)
    }

    /// Whether the pixel lies on the image and inside the image circle.
    #[must_use]
    pub fn sees(&self, pixel: &Vector2<f64>) -> bool {
        let inside = pixel.x >= -0.5
            && pixel.y >= -0.5
            && pixel.x <= f64::from(self.width) - 0.5
            && pixel.y <= f64::from(self.height) - 0.5;
        inside
            && self
                .valid_radius
                .is_none_or(|radius| (pixel - self.centre()).norm() <= radius)
    }

    /// The principal point.
    #[must_use]
    pub fn centre(&self) -> Vector2<f64> {
        let (_, _, cx, cy) = self.lens.linear();
        Vector2::new(cx, cy)
    }

    /// The camera of the image resized by `scale` in both directions.
    #[must_use]
    pub fn resized(&self, scale: f64) -> Camera {
        let mut lens = self.lens.clone();
        lens.map_linear(|fx, fy, cx, cy| {
            (
                fx * scale,
                fy * scale,
                scale * (cx + 0.5) - 0.5,
                scale * (cy + 0.5) - 0.5,
            )
        });
        Camera {
            lens,
            width: (f64::from(self.width) * scale).round() as u32,
            height: (f64::from(self.height) * scale).round() as u32,
            valid_radius: self.valid_radius.map(|radius| radius * scale),
        }
    }

    /// The camera of the image turned by a quarter clockwise. Its x axis is the old -y, its y axis the old x.
    #[must_use]
    pub fn turned_clockwise(&self) -> Camera {
        let mut lens = self.lens.clone();
        let below = f64::from(self.height) - 1.0;
        lens.map_linear(|fx, fy, cx, cy| (fy, fx, below - cy, cx));
        if let Lens::Fisheye624(fisheye) = &mut lens {
            let [p0, p1] = fisheye.tangential;
            let [s0, s1, s2, s3] = fisheye.prism;
            fisheye.tangential = [-p1, p0];
            fisheye.prism = [-s2, -s3, s0, s1];
        }
        if let Lens::Rational(rational) = &mut lens {
            let [_, _, p1, p2, ..] = rational.distortion;
            rational.distortion[2..4].copy_from_slice(&[p2, -p1]);
        }
        Camera {
            lens,
            width: self.height,
            height: self.width,
            valid_radius: self.valid_radius,
        }
    }

    /// The camera of the image resized to `width` x `height`.
    #[must_use]
    pub fn resized_to(&self, width: u32, height: u32) -> Camera {
        let x = f64::from(width) / f64::from(self.width);
        let y = f64::from(height) / f64::from(self.height);
        let mut lens = self.lens.clone();
        lens.map_linear(|fx, fy, cx, cy| {
            (fx * x, fy * y, x * (cx + 0.5) - 0.5, y * (cy + 0.5) - 0.5)
        });
        Camera {
            lens,
            width,
            height,
            valid_radius: self.valid_radius.map(|radius| radius * x.min(y)),
        }
    }

    /// The camera of the part of the image that starts at (`left`, `top`).
    #[must_use]
    pub fn cropped(&self, left: f64, top: f64, width: u32, height: u32) -> Camera {
        let mut lens = self.lens.clone();
        lens.map_linear(|fx, fy, cx, cy| (fx, fy, cx - left, cy - top));
        Camera {
            lens,
            width,
            height,
            valid_radius: self.valid_radius,
        }
    }
}

impl Lens {
    /// `(fx, fy, cx, cy)`.
    fn linear(&self) -> (f64, f64, f64, f64) {
        match *self {
            Lens::Pinhole(Pinhole { fx, fy, cx, cy })
            | Lens::Fisheye624(Fisheye624 { fx, fy, cx, cy, .. })
            | Lens::KannalaBrandt(KannalaBrandt { fx, fy, cx, cy, .. })
            | Lens::Rational(Rational { fx, fy, cx, cy, .. }) => (fx, fy, cx, cy),
        }
    }

    fn map_linear(&mut self, change: impl Fn(f64, f64, f64, f64) -> (f64, f64, f64, f64)) {
        match self {
            Lens::Pinhole(Pinhole { fx, fy, cx, cy })
            | Lens::Fisheye624(Fisheye624 { fx, fy, cx, cy, .. })
            | Lens::KannalaBrandt(KannalaBrandt { fx, fy, cx, cy, .. })
            | Lens::Rational(Rational { fx, fy, cx, cy, .. }) => {
                (*fx, *fy, *cx, *cy) = change(*fx, *fy, *cx, *cy);
            }
        }
    }
}

impl Pinhole {
    fn project(&self, p: &Vector3<f64>) -> Option<Vector2<f64>> {
        (p.z > 0.0)
            .then(|| Vector2::new(self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy))
    }

    fn unproject(&self, pixel: &Vector2<f64>) -> Vector3<f64> {
        Vector3::new(
            (pixel.x - self.cx) / self.fx,
            (pixel.y - self.cy) / self.fy,
            1.0,
        )
    }
}

impl Fisheye624 {
    /// From the parameter vectors that recordings carry: 15 values `f cx cy k0..k5 p0 p1 s0..s3`, or 16 with `fx fy`.
    #[must_use]
    pub fn from_parameters(values: &[f64]) -> Option<Self> {
        let (fx, fy, rest) = match values.len() {
            15 => (values[0], values[0], &values[1..]),
            16 => (values[0], values[1], &values[2..]),
            _ => return None,
        };
        let mut lens = Fisheye624 {
            fx,
            fy,
            cx: rest[0],
            cy: rest[1],
            radial: [0.0; 6],
            tangential: [0.0; 2],
            prism: [0.0; 4],
        };
        lens.radial.copy_from_slice(&rest[2..8]);
        lens.tangential.copy_from_slice(&rest[8..10]);
        lens.prism.copy_from_slice(&rest[10..14]);
        (values.iter().all(|v| v.is_finite()) && fx > 0.0 && fy > 0.0).then_some(lens)
    }

    /// Tangential and thin-prism terms on the radially distorted point.
    fn decentred(&self, q: &Vector2<f64>) -> Vector2<f64> {
        let [p0, p1] = self.tangential;
        let [s0, s1, s2, s3] = self.prism;
        let d2 = q.norm_squared();
        let t = 2.0 * (q.x * p0 + q.y * p1);
        Vector2::new(
            q.x + t * q.x + d2 * p0 + s0 * d2 + s1 * d2 * d2,
            q.y + t * q.y + d2 * p1 + s2 * d2 + s3 * d2 * d2,
        )
    }

    fn decentred_jacobian(&self, q: &Vector2<f64>) -> Matrix2<f64> {
        let [p0, p1] = self.tangential;
        let [s0, s1, s2, s3] = self.prism;
        let d2 = q.norm_squared();
        let t = 2.0 * (q.x * p0 + q.y * p1);
        // d(d2)/dq = 2q, d(d2^2)/dq = 4 d2 q, dt/dq = 2 (p0, p1)
        let along_x = 2.0 * (p0 + s0) + 4.0 * s1 * d2;
        let along_y = 2.0 * (p1 + s2) + 4.0 * s3 * d2;
        Matrix2::new(
            1.0 + t + 2.0 * p0 * q.x + along_x * q.x,
            2.0 * p1 * q.x + along_x * q.y,
            2.0 * p0 * q.y + along_y * q.x,
            1.0 + t + 2.0 * p1 * q.y + along_y * q.y,
        )
    }

    fn project(&self, p: &Vector3<f64>) -> Option<Vector2<f64>> {
        if p.z <= 0.0 {
            return None;
        }
        let ray = Vector2::new(p.x / p.z, p.y / p.z);
        let r = ray.norm();
        let stretch = if r > 1e-12 {
            radial(&self.radial, r.atan()).0 / r
        } else {
            1.0
        };
        let d = self.decentred(&(ray * stretch));
        Some(Vector2::new(
            self.fx * d.x + self.cx,
            self.fy * d.y + self.cy,
        ))
    }

    fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        let wanted = Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        // First undo the decentring terms, then the radial polynomial.
        let mut q = wanted;
        let mut converged = false;
        for _ in 0..MAX_STEPS {
            let step = self.decentred_jacobian(&q).try_inverse()? * (self.decentred(&q) - wanted);
            q -= step;
            if step.norm() < TOLERANCE {
                converged = true;
                break;
            }
        }
        if !converged {
            return None;
        }
        let radius = q.norm();
        if radius < 1e-12 {
            return Some(Vector3::new(q.x, q.y, 1.0));
        }
        let theta = invert_angle(radius, |theta| radial(&self.radial, theta))?;
        ray_at(theta, &(q / radius))
    }
}

impl KannalaBrandt {
    fn project(&self, p: &Vector3<f64>) -> Option<Vector2<f64>> {
        let radius = p.x.hypot(p.y);
        if radius < 1e-12 {
            return (p.z > 0.0).then(|| Vector2::new(self.cx, self.cy));
        }
        let (angle, _) = radial(&self.radial, radius.atan2(p.z));
        Some(Vector2::new(
            self.fx * angle * p.x / radius + self.cx,
            self.fy * angle * p.y / radius + self.cy,
        ))
    }

    fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        let q = Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        let radius = q.norm();
        if radius < 1e-12 {
            return Some(Vector3::new(q.x, q.y, 1.0));
        }
        let theta = invert_angle(radius, |theta| radial(&self.radial, theta))?;
        ray_at(theta, &(q / radius))
    }
}

impl Rational {
    /// The distorted point of a point on the plane z = 1, and the derivative.
    fn distorted(&self, p: &Vector2<f64>) -> (Vector2<f64>, Matrix2<f64>) {
        let [k1, k2, p1, p2, k3, k4, k5, k6] = self.distortion;
        let r2 = p.norm_squared();
        let above = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3));
        let below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6));
        let radial = above / below;
        // d(radial)/d(r2)
        let slope = ((k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3)) * below
            - above * (k4 + r2 * (2.0 * k5 + 3.0 * r2 * k6)))
            / (below * below);
        let (x, y) = (p.x, p.y);
        let value = Vector2::new(
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        );
        let cross = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
        let jacobian = Matrix2::new(
            radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
            cross,
            cross,
            radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
        );
        (value, jacobian)
    }

    fn project(&self, p: &Vector3<f64>) -> Option<Vector2<f64>> {
        if p.z <= 0.0 {
            return None;
        }
        let (d, jacobian) = self.distorted(&Vector2::new(p.x / p.z, p.y / p.z));
        // Beyond where the polynomials turn back, pixels mean nothing.
        (jacobian.determinant() > 0.0)
            .then(|| Vector2::new(self.fx * d.x + self.cx, self.fy * d.y + self.cy))
    }

    fn unproject(&self, pixel: &Vector2<f64>) -> Option<Vector3<f64>> {
        let target = Vector2::new((pixel.x - self.cx) / self.fx, (pixel.y - self.cy) / self.fy);
        let mut q = target;
        for _ in 0..MAX_STEPS {
            let (value, jacobian) = self.distorted(&q);
            let step = jacobian.try_inverse()? * (value - target);
            q -= step;
            if step.norm() < TOLERANCE {
                return (self.distorted(&q).1.determinant() > 0.0)
                    .then(|| Vector3::new(q.x, q.y, 1.0));
            }
        }
        None
    }
}

/// The radially distorted angle of an angle to the optical axis, and its derivative.
fn radial(terms: &[f64], theta: f64) -> (f64, f64) {
    let square = theta * theta;
    let (mut power, mut value, mut slope) = (1.0, 1.0, 1.0);
    for (i, k) in terms.iter().enumerate() {
        power *= square;
        value += k * power;
        slope += k * power * (2 * i + 3) as f64;
    }
    (theta * value, slope)
}

/// The angle whose distorted value is `radius`.
fn invert_angle(radius: f64, distorted: impl Fn(f64) -> (f64, f64)) -> Option<f64> {
    let mut theta = radius.min(1.5);
    for _ in 0..MAX_STEPS {
        let (value, slope) = distorted(theta);
        if slope.abs() < 1e-9 || !slope.is_finite() {
            return None;
        }
        let step = (value - radius) / slope;
        theta -= step;
        if step.abs() < TOLERANCE {
            return Some(theta);
        }
    }
    None
}

/// The ray at `theta` from the optical axis in `direction`, scaled to z = 1.
fn ray_at(theta: f64, direction: &Vector2<f64>) -> Option<Vector3<f64>> {
    (0.0..std::f64::consts::FRAC_PI_2)
        .contains(&theta)
        .then(|| {
            let r = theta.tan();
            Vector3::new(r * direction.x, r * direction.y, 1.0)
        })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// A lens with the distortion of a real Aria colour camera.
    pub(crate) fn aria_like() -> Camera {
        Camera {
            lens: Lens::Fisheye624(
                Fisheye624::from_parameters(&[
                    610.0, 714.0, 716.0, 0.4, -0.48, 0.17, 1.13, -1.70, 0.65, 6e-4, 2e-5, -1e-5,
                    2.6e-4, -6.6e-4, 3.8e-5,
                ])
                .unwrap(),
            ),
            width: 1408,
            height: 1408,
            valid_radius: Some(707.5),
        }
    }

    fn kannala() -> Camera {
        Camera {
            lens: Lens::KannalaBrandt(KannalaBrandt {
                fx: 900.0,
                fy: 905.0,
                cx: 960.0,
                cy: 540.0,
                radial: [0.03, -0.01, 0.004, -0.001],
            }),
            width: 1920,
            height: 1080,
            valid_radius: None,
        }
    }

    proptest! {
        #[test]
        fn a_turned_camera_sees_the_turned_picture(x in -1.0f64..1.0, y in -1.0f64..1.0) {
            for camera in [aria_like(), kannala()] {
                let stored = camera.project(&Vector3::new(x, y, 1.0)).unwrap();
                let turned = camera.turned_clockwise();
                let pixel = turned.project(&Vector3::new(-y, x, 1.0)).unwrap();
                let expected = Vector2::new(f64::from(camera.height) - 1.0 - stored.y, stored.x);
                prop_assert!((pixel - expected).norm() < 1e-9);
                prop_assert_eq!((turned.width, turned.height), (camera.height, camera.width));
            }
        }

        #[test]
        fn unproject_inverts_project(x in -1.0f64..1.0, y in -1.0f64..1.0, depth in 0.1f64..20.0) {
            let pinhole = Camera {
                lens: Lens::Pinhole(Pinhole { fx: 150.0, fy: 150.0, cx: 255.5, cy: 255.5 }),
                width: 512, height: 512, valid_radius: None,
            };
            for camera in [aria_like(), kannala(), pinhole] {
                let ray = Vector3::new(x, y, 1.0);
                let pixel = camera.project(&(ray * depth)).unwrap();
                let back = camera.unproject(&pixel).unwrap();
                prop_assert!((back - ray).norm() < 1e-7, "{back} {ray}");
            }
        }

        #[test]
        fn resizing_and_cropping_move_pixels_as_they_move_images(x in -0.8f64..0.8, y in -0.8f64..0.8) {
            let camera = aria_like();
            let ray = Vector3::new(x, y, 1.0);
            let pixel = camera.project(&ray).unwrap();
            let small = camera.cropped(64.0, 32.0, 1280, 1280).resized(0.25).project(&ray).unwrap();
            let expected = (pixel - Vector2::new(64.0, 32.0) + Vector2::repeat(0.5)) * 0.25 - Vector2::repeat(0.5);
            prop_assert!((small - expected).norm() < 1e-9);
        }

        #[test]
        fn no_parameters_make_the_inversion_hang_or_panic(values in proptest::collection::vec(-1e3f64..1e3, 15), u in -1e4f64..1e4, v in -1e4f64..1e4) {
            if let Some(lens) = Fisheye624::from_parameters(&values) {
                let camera = Camera { lens: Lens::Fisheye624(lens), width: 10, height: 10, valid_radius: None };
                if let Some(ray) = camera.unproject(&Vector2::new(u, v)) {
                    prop_assert!(ray.z == 1.0 && ray.x.is_finite());
                }
            }
        }
    }

    #[test]
    fn points_behind_the_camera_have_no_pixel() {
        assert_eq!(aria_like().project(&Vector3::new(0.1, 0.1, -1.0)), None);
        assert_eq!(aria_like().project(&Vector3::new(0.0, 0.0, 0.0)), None);
    }

    #[test]
    fn the_jacobian_is_the_derivative() {
        let Lens::Fisheye624(mut lens) = aria_like().lens else {
            unreachable!()
        };
        lens.tangential = [0.01, -0.02];
        lens.prism = [0.03, -0.01, 0.02, 0.04];
        let q = Vector2::new(0.4, -0.7);
        let h = 1e-6;
        for axis in 0..2 {
            let mut ahead = q;
            ahead[axis] += h;
            let mut back = q;
            back[axis] -= h;
            let numeric = (lens.decentred(&ahead) - lens.decentred(&back)) / (2.0 * h);
            assert!((numeric - lens.decentred_jacobian(&q).column(axis)).norm() < 1e-8);
        }
    }

    #[test]
    fn the_rational_model_agrees_with_opencv_and_comes_back() {
        let lens = Rational {
            fx: 900.0,
            fy: 910.0,
            cx: 640.0,
            cy: 360.0,
            distortion: [0.5, -0.2, 1e-3, -2e-3, 0.01, 0.7, -0.1, 0.02],
        };
        let camera = Camera {
            lens: Lens::Rational(lens),
            width: 1280,
            height: 720,
            valid_radius: None,
        };
        let point = Vector3::new(0.3, -0.2, 1.0);
        let pixel = camera.project(&point).unwrap();
        // x'' and y'' by OpenCV's formula, written out.
        let r2: f64 = 0.13;
        let radial = (1.0 + 0.5 * r2 - 0.2 * r2.powi(2) + 0.01 * r2.powi(3))
            / (1.0 + 0.7 * r2 - 0.1 * r2.powi(2) + 0.02 * r2.powi(3));
        let x = 0.3 * radial + 2.0 * 1e-3 * 0.3 * -0.2 + -2e-3 * (r2 + 2.0 * 0.09);
        let y = -0.2 * radial + 1e-3 * (r2 + 2.0 * 0.04) + 2.0 * -2e-3 * 0.3 * -0.2;
        assert!((pixel - Vector2::new(900.0 * x + 640.0, 910.0 * y + 360.0)).norm() < 1e-9);
        assert!((camera.unproject(&pixel).unwrap() - point).norm() < 1e-9);
        let half = camera.resized_to(640, 360).project(&point).unwrap();
        assert!((half - (pixel.add_scalar(0.5) / 2.0).add_scalar(-0.5)).norm() < 1e-9);
    }
}
