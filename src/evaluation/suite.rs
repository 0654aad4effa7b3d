//! A suite: which columns are computed on which clips. Registry entries `suite: adt_body`, ...

use super::columns::Column;
use super::metric::names;
use super::sample::Sample;
use serde::{Deserialize, Serialize};

/// What an evaluation computes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Suite {
    /// Columns, `modality.metric` or `modality.metric@space`; `depth.abs_rel` stands for all its spaces. A modality declared in
    /// YAML has `<modality>.rmse`.
    pub metrics: Vec<String>,
    /// Draw this many clips instead of taking all; anyone with the same clips and seed draws the same.
    pub sample: Option<Sample>,
    /// Ground-truth depth at or below this many metres is not scored (`dmin`), and predicted depth is clamped to it.
    #[schemars(range(min = 0.001))]
    pub depth_min: Option<f64>,
    /// Ground-truth depth at or beyond this many metres is not scored (`dmax`), and predicted depth is clamped to it.
    #[schemars(range(min = 0.001))]
    pub depth_max: Option<f64>,
}

impl Default for Suite {
    fn default() -> Self {
        let metrics = [
            "body.ga_mpjpe",
            "body.pa_mpjpe",
            "body.kin_fid",
            "body.kin_cos",
            "hands.ga_mpjpe",
            "hands.ra_mpjpe",
            "hands.pa_mpjpe",
            "camera.ate",
            "camera.rte",
            "camera.rre",
            "gaze.mse",
            "depth.abs_rel@depth",
            "depth.abs_rel@disparity",
            "depth.delta@depth",
            "depth.delta@disparity",
        ];
        Self {
            metrics: metrics.map(str::to_owned).to_vec(),
            sample: None,
            depth_min: None,
            depth_max: None,
        }
    }
}

/// A name in `metrics` that is no column.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("no metric `{name}`")]
pub struct UnknownMetric {
    /// The name, as the suite has it.
    pub name: String,
    /// Every name there is, for a suggestion.
    pub known: Vec<&'static str>,
}

impl Suite {
    /// The clips of `ids` that are evaluated, by their place.
    #[must_use]
    pub fn chosen(&self, ids: &[String]) -> Vec<usize> {
        match &self.sample {
            Some(sample) => sample.draw(ids),
            None => (0..ids.len()).collect(),
        }
    }

    /// The columns that `metrics` names, in that order, each once.
    ///
    /// # Errors
    /// When a name is no column.
    pub fn columns(&self) -> Result<Vec<Column>, UnknownMetric> {
        let mut columns: Vec<Column> = Vec::new();
        for name in &self.metrics {
            let found: Vec<Column> = match Column::named(name) {
                Some(column) => vec![column],
                None => names()
                    .into_iter()
                    .filter_map(Column::named)
                    .filter(|column| column.answers_to(name))
                    .collect(),
            };
            if found.is_empty() {
                return Err(UnknownMetric {
                    name: name.clone(),
                    known: names(),
                });
            }
            for column in found {
                if !columns.contains(&column) {
                    columns.push(column);
                }
            }
        }
        Ok(columns)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_name_without_its_space_stands_for_all_spaces() {
        let suite = |names: &[&str]| Suite {
            metrics: names.iter().map(|n| (*n).to_owned()).collect(),
            ..Suite::default()
        };
        let columns = suite(&["depth.abs_rel", "depth.abs_rel@none", "head_imu.rmse"])
            .columns()
            .unwrap();
        assert_eq!(columns.len(), 5);
        assert_eq!(
            suite(&["body.gmpjpe"]).columns().unwrap_err().name,
            "body.gmpjpe"
        );
        assert!(Suite::default().columns().is_ok());
    }
}
