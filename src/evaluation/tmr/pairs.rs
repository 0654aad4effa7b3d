//! The embeddings of true and predicted bodies of a set of clips.

use ndarray::Array2;
use rayon::prelude::*;

use super::{FeatureRate, TRAINED_RATE, Tmr};
use crate::clip::JointTrack;
use crate::evaluation::evaluate::{Embeddings, EvaluationError, Pairs};

/// Clips that are embedded before their rows are kept: fixed, so results do not depend on threads.
const CHUNK: usize = 64;

impl Tmr {
    /// Embeds truth and prediction of the clips `chosen` whose body is there, with every joint valid, on both sides. Says what the
    /// numbers stand for, too.
    ///
    /// # Errors
    /// When a clip cannot be read, or a motion has no features.
    pub fn embed_pairs(
        &self,
        pairs: &dyn Pairs,
        chosen: &[usize],
        rate: FeatureRate,
    ) -> Result<(Embeddings, String), EvaluationError> {
        let mut rows: [Vec<f64>; 2] = Default::default();
        let mut count = 0;
        for chunk in chosen.chunks(CHUNK) {
            let found: Vec<Option<[Vec<f64>; 2]>> = chunk
                .par_iter()
                .map(|index| self.embed_pair(pairs, *index, rate))
                .collect::<Result<_, _>>()?;
            for pair in found.into_iter().flatten() {
                count += 1;
                for (rows, row) in rows.iter_mut().zip(pair) {
                    rows.extend(row);
                }
            }
        }
        let width = self.encoder.settings().width;
        let [predicted, truth] = rows.map(|rows| {
            Array2::from_shape_vec((count, width), rows)
                .expect("every embedding has the encoder's width")
        });
        let features = match rate {
            FeatureRate::Trained => format!("features at {TRAINED_RATE} Hz"),
            FeatureRate::Native => "features at the motion's own rate".to_owned(),
        };
        let settings = self.encoder.settings();
        let about = format!(
            "motion.*: TMR encoder of width {}, {} layers, weights {}; {features}, normalised by the statistics in its folder; \
             {count} of {} clips have every joint on both sides; fid of rows of unit length, fid_raw of rows as they are, \
             similarity = mean of (cos + 1)/2",
            settings.width,
            settings.layers,
            self.fingerprint().get(..12).unwrap_or("made here"),
            chosen.len()
        );
        Ok((Embeddings { predicted, truth }, about))
    }

    fn embed_pair(
        &self,
        pairs: &dyn Pairs,
        index: usize,
        rate: FeatureRate,
    ) -> Result<Option<[Vec<f64>; 2]>, EvaluationError> {
        let clip = || pairs.ids()[index].clone();
        let load = |error| EvaluationError::Load {
            clip: clip(),
            error,
        };
        let Some(prediction) = pairs.prediction(index).map_err(load)? else {
            return Ok(None);
        };
        let truth = pairs.truth(index).map_err(load)?;
        let (Some(predicted), Some(truth)) = (prediction.body(), truth.body()) else {
            return Ok(None);
        };
        if !whole(predicted) || !whole(truth) {
            return Ok(None);
        }
        let embed = |track: &JointTrack| {
            let joints = track.joints.mapv(f64::from);
            self.embed(joints.view(), track.rate, rate)
                .map_err(|refusal| EvaluationError::Refused {
                    clip: clip(),
                    refusal,
                })
        };
        Ok(Some([embed(predicted)?, embed(truth)?]))
    }
}

fn whole(track: &JointTrack) -> bool {
    track.valid.iter().all(|valid| *valid)
}
