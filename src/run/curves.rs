//! Curves of metrics as SVG; the one file that knows the plotting library.

use kuva::plot::LinePlot;
use kuva::render::layout::Layout;
use kuva::render::palette::Palette;
use kuva::render::plots::Plot;

/// One line of a plot.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve {
    /// In the legend; empty for none.
    pub name: String,
    /// Step and value, in order of steps.
    pub points: Vec<(f64, f64)>,
}

/// More points than pixels help nobody.
const POINTS: usize = 400;

/// A plot of curves over steps, or `None` where there is no finite point.
pub fn svg(title: &str, curves: &[Curve]) -> Option<String> {
    let colours = Palette::wong();
    let mut plots: Vec<Plot> = Vec::new();
    for (index, curve) in curves.iter().enumerate() {
        let points = thin(&curve.points);
        if points.is_empty() {
            continue;
        }
        let mut line = LinePlot::new()
            .with_data(points)
            .with_color(&colours[index % colours.len()])
            .with_stroke_width(1.5);
        if !curve.name.is_empty() {
            line = line.with_legend(curve.name.as_str());
        }
        plots.push(line.into());
    }
    if plots.is_empty() {
        return None;
    }
    let layout = Layout::auto_from_plots(&plots)
        .with_title(title)
        .with_x_label("step")
        .with_width(460.0)
        .with_height(280.0);
    Some(kuva::render_to_svg(plots, layout))
}

/// Means of equal bins where there are too many points; what is not finite is left out.
fn thin(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let finite: Vec<(f64, f64)> = points
        .iter()
        .copied()
        .filter(|(x, y)| x.is_finite() && y.is_finite())
        .collect();
    let size = finite.len().div_ceil(POINTS).max(1);
    let mean = |bin: &[(f64, f64)]| {
        let n = bin.len() as f64;
        let (x, y) = bin
            .iter()
            .fold((0.0, 0.0), |sum, point| (sum.0 + point.0, sum.1 + point.1));
        (x / n, y / n)
    };
    finite.chunks(size).map(mean).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_curves_are_thinned_and_keep_their_mean() {
        let points: Vec<(f64, f64)> = (0..10_000)
            .map(|i| (f64::from(i), f64::from(i % 2)))
            .collect();
        let thin = thin(&points);
        assert!(thin.len() <= POINTS);
        assert!(thin.iter().all(|(_, y)| (y - 0.5).abs() < 0.05));
    }

    #[test]
    fn a_curve_without_a_finite_point_makes_no_plot() {
        let curve = Curve {
            name: String::new(),
            points: vec![(1.0, f64::NAN)],
        };
        assert_eq!(svg("loss", &[curve]), None);
        let one = Curve {
            name: "a".into(),
            points: vec![(1.0, 2.0)],
        };
        assert!(svg("loss <&>", &[one]).unwrap().contains("<svg"));
    }
}
