//! Several sources as one, each with its share.

use super::{Outcome, Source, SourceError};
use std::sync::Arc;

/// Clips of several sources, interleaved so that every stretch of the list holds each source in its share.
pub struct Mixture {
    name: String,
    parts: Vec<Part>,
    /// For every clip which part it comes from and its index there.
    order: Vec<(u32, u32)>,
}

struct Part {
    source: Arc<dyn Source>,
}

impl std::fmt::Debug for Mixture {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Mixture")
            .field("name", &self.name)
            .field(
                "parts",
                &self
                    .parts
                    .iter()
                    .map(|part| part.source.name().to_owned())
                    .collect::<Vec<_>>(),
            )
            .field("clips", &self.order.len())
            .finish()
    }
}

impl Mixture {
    /// `length` clips of `parts` in proportion to their weights. A source with fewer clips than its share starts again from its
    /// first clip; one with weight zero takes no part.
    ///
    /// # Errors
    /// When a weight is negative or not finite, all are zero, or a source that takes part is empty.
    pub fn new(
        name: &str,
        parts: Vec<(Arc<dyn Source>, f64)>,
        length: usize,
    ) -> Result<Self, SourceError> {
        let wrong = |what: String| Err(SourceError::Settings(what));
        for (source, weight) in &parts {
            if !(weight.is_finite() && *weight >= 0.0) {
                return wrong(format!(
                    "`{}` has a weight of {weight} in `{name}`",
                    source.name()
                ));
            }
            if *weight > 0.0 && source.is_empty() {
                return wrong(format!(
                    "`{}` has no clips to take part in `{name}`",
                    source.name()
                ));
            }
        }
        let total: f64 = parts.iter().map(|(_, weight)| weight).sum();
        if total <= 0.0 {
            return wrong(format!("no source of `{name}` has a weight"));
        }
        // Each step takes the source that is farthest behind its share: counts never differ from shares by more than one.
        let mut taken = vec![0_u64; parts.len()];
        let mut order = Vec::with_capacity(length);
        for step in 1..=length {
            let behind = |k: usize| parts[k].1 / total * step as f64 - taken[k] as f64;
            let next = (0..parts.len())
                .filter(|&k| parts[k].1 > 0.0)
                .max_by(|&a, &b| behind(a).total_cmp(&behind(b)).then(b.cmp(&a)))
                .unwrap_or(0);
            order.push((
                next as u32,
                (taken[next] % parts[next].0.len() as u64) as u32,
            ));
            taken[next] += 1;
        }
        Ok(Mixture {
            name: name.to_owned(),
            parts: parts
                .into_iter()
                .map(|(source, _)| Part { source })
                .collect(),
            order,
        })
    }
}

impl Source for Mixture {
    fn name(&self) -> &str {
        &self.name
    }

    fn len(&self) -> usize {
        self.order.len()
    }

    fn modalities(&self) -> Vec<String> {
        let order = [
            "rgb",
            "depth",
            "camera",
            "gaze",
            "left_hand",
            "right_hand",
            "body",
        ];
        order
            .iter()
            .filter(|name| {
                self.parts
                    .iter()
                    .any(|part| part.source.modalities().iter().any(|m| m == *name))
            })
            .map(|name| (*name).to_owned())
            .collect()
    }

    fn clip(&self, index: usize) -> Result<Outcome, SourceError> {
        let (part, inside) = *self
            .order
            .get(index)
            .ok_or_else(|| SourceError::OutOfRange {
                source_name: self.name.clone(),
                index,
                len: self.order.len(),
            })?;
        self.parts[part as usize].source.clip(inside as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::source::DropReason;
    use proptest::prelude::*;

    struct Fake(&'static str, usize);

    impl Source for Fake {
        fn name(&self) -> &str {
            self.0
        }
        fn len(&self) -> usize {
            self.1
        }
        fn modalities(&self) -> Vec<String> {
            vec!["gaze".to_owned(), self.0.to_owned()]
        }
        fn clip(&self, index: usize) -> Result<Outcome, SourceError> {
            Ok(Outcome::Dropped {
                id: format!("{}/{index}", self.0),
                reason: DropReason::VideoGap,
            })
        }
    }

    fn ids(mixture: &Mixture) -> Vec<String> {
        crate::source::clips(mixture)
            .map(|outcome| match outcome.unwrap() {
                Outcome::Dropped { id, .. } => id,
                Outcome::Clip(_) => unreachable!(),
            })
            .collect()
    }

    proptest! {
        #[test]
        fn every_prefix_holds_each_source_in_its_share(a in 0.1f64..5.0, b in 0.1f64..5.0, length in 1usize..200) {
            let mixture = Mixture::new("m", vec![(Arc::new(Fake("a", 7)), a), (Arc::new(Fake("b", 1000)), b)], length).unwrap();
            let mut count = 0.0;
            for (step, id) in ids(&mixture).iter().enumerate() {
                count += f64::from(u8::from(id.starts_with('a')));
                prop_assert!((count - (step + 1) as f64 * a / (a + b)).abs() <= 1.0);
            }
        }
    }

    #[test]
    fn small_sources_start_again_and_modalities_add_up() {
        let mixture = Mixture::new(
            "m",
            vec![
                (Arc::new(Fake("rgb", 2)), 1.0),
                (Arc::new(Fake("body", 9)), 1.0),
            ],
            8,
        )
        .unwrap();
        let ids = ids(&mixture);
        assert_eq!(ids.iter().filter(|id| **id == "rgb/0").count(), 2);
        assert_eq!(mixture.modalities(), ["rgb", "gaze", "body"]);
        assert!(mixture.clip(8).is_err());
        assert!(Mixture::new("m", vec![(Arc::new(Fake("a", 0)), 1.0)], 3).is_err());
    }
}
