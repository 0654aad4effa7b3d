//! Planes: distance, ray intersection, least-squares fit (floors for the metric alignment of Sec. 4.1).

use nalgebra::{Matrix3, Point3, Unit, Vector3};

/// The points `x` with `normal · x = offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plane {
    pub normal: Unit<Vector3<f64>>,
    /// Signed distance of the plane from the origin along the normal, metres.
    pub offset: f64,
}

impl Plane {
    /// The plane through `point` with that normal.
    pub fn through(point: &Point3<f64>, normal: Unit<Vector3<f64>>) -> Self {
        Self {
            normal,
            offset: normal.dot(&point.coords),
        }
    }

    /// Least squares over at least three points that are not on a line; the normal points to the side of `up`.
    pub fn fit(points: &[Point3<f64>], up: &Vector3<f64>) -> Option<Self> {
        if points.len() < 3 {
            return None;
        }
        let centre =
            points.iter().fold(Vector3::zeros(), |a, p| a + p.coords) / points.len() as f64;
        let scatter = points.iter().fold(Matrix3::zeros(), |a, p| {
            let d = p.coords - centre;
            a + d * d.transpose()
        });
        if !scatter.iter().all(|v| v.is_finite()) {
            return None;
        }
        let eigen = scatter.symmetric_eigen();
        let mut order = [0, 1, 2];
        order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
        if eigen.eigenvalues[order[1]] <= 1e-9 * eigen.eigenvalues[order[2]].max(1e-12) {
            return None;
        }
        let mut normal: Vector3<f64> = eigen.eigenvectors.column(order[0]).into_owned();
        if normal.dot(up) < 0.0 {
            normal = -normal;
        }
        Some(Self::through(&centre.into(), Unit::new_normalize(normal)))
    }

    /// Positive on the side the normal points to.
    pub fn signed_distance(&self, point: &Point3<f64>) -> f64 {
        self.normal.dot(&point.coords) - self.offset
    }

    /// The parameter `t` at which `origin + t direction` meets the plane; `None` where it runs parallel.
    pub fn intersect(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<f64> {
        let along = self.normal.dot(direction);
        (along.abs() > 1e-12).then(|| -self.signed_distance(origin) / along)
    }

    /// The nearest point of the plane.
    pub fn project(&self, point: &Point3<f64>) -> Point3<f64> {
        point - self.normal.into_inner() * self.signed_distance(point)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_fit_recovers_the_plane_and_points_up() {
        let plane = Plane::through(
            &Point3::new(0.0, 0.0, -1.5),
            Unit::new_normalize(Vector3::new(0.1, -0.2, 1.0)),
        );
        let points: Vec<_> = (0..20)
            .map(|i| {
                let p = Point3::new(f64::from(i % 5), f64::from(i / 5), 0.0);
                plane.project(&p)
            })
            .collect();
        let fit = Plane::fit(&points, &Vector3::z()).unwrap();
        assert!((fit.normal.into_inner() - plane.normal.into_inner()).norm() < 1e-9);
        assert!((fit.offset - plane.offset).abs() < 1e-9);
    }

    #[test]
    fn lines_and_pairs_have_no_plane() {
        let line: Vec<_> = (0..9)
            .map(|i| Point3::new(f64::from(i), 0.0, 1.0))
            .collect();
        assert!(Plane::fit(&line, &Vector3::z()).is_none());
        assert!(Plane::fit(&line[..2], &Vector3::z()).is_none());
    }

    #[test]
    fn rays_meet_the_plane_where_its_distance_is_zero() {
        let plane = Plane {
            normal: Vector3::z_axis(),
            offset: 0.0,
        };
        let (o, d) = (Point3::new(0.0, 0.0, 1.6), Vector3::new(1.0, 0.0, -0.8));
        let t = plane.intersect(&o, &d).unwrap();
        assert!(plane.signed_distance(&(o + d * t)).abs() < 1e-12);
        assert!(plane.intersect(&o, &Vector3::x()).is_none());
    }
}
