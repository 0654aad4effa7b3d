//! What clips hold, modality by modality: how many have it, how much of it is valid, and the mean, spread and range of every
//! channel in its unit. Colour is counted in levels of 0 to 255 and depth in metres, everything else as its modality has it.

use super::{ClipFormat, Modality, all};
use crate::clip::Clip;
use crate::clip::statistics::SignalStatistics;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Statistics of many clips.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Inventory {
    /// Clips that were counted.
    pub clips: u64,
    /// In the order of [`all`].
    pub modalities: Vec<Row>,
}

/// One modality of an [`Inventory`].
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Row {
    /// Its registry name.
    pub modality: String,
    /// Samples per second.
    pub rate: f64,
    /// The frame of reference, in words.
    pub frame: String,
    /// Shapes that were met, as `60x21x3`, and in how many clips.
    pub shapes: BTreeMap<String, u64>,
    /// Of the clips that it can be taken out of, by channel.
    pub statistics: SignalStatistics,
    /// Clips whose signal the modality cannot represent, by reason.
    pub refused: BTreeMap<String, u64>,
}

/// Takes stock of clips of one format.
pub struct Counter {
    format: ClipFormat,
    inventory: Inventory,
}

impl Counter {
    /// Nothing counted yet.
    pub fn new(format: &ClipFormat) -> Self {
        Self {
            format: format.clone(),
            inventory: Inventory::of(format),
        }
    }

    /// Adds clips, counted on all cores; the result does not depend on how many there are.
    pub fn add(&mut self, clips: &[Clip]) {
        let counted: Vec<Inventory> = clips
            .par_iter()
            .map(|clip| count(clip, &self.format))
            .collect();
        for inventory in &counted {
            self.inventory.merge(inventory);
        }
    }

    /// Everything counted so far.
    pub fn inventory(&self) -> &Inventory {
        &self.inventory
    }
}

impl Inventory {
    /// Of no clips of this format.
    pub fn of(format: &ClipFormat) -> Self {
        empty(&all(format))
    }

    /// Adds an inventory of the same modalities.
    pub fn merge(&mut self, other: &Inventory) {
        self.clips += other.clips;
        for (row, more) in self.modalities.iter_mut().zip(&other.modalities) {
            row.statistics.merge(&more.statistics);
            for (shape, clips) in &more.shapes {
                *row.shapes.entry(shape.clone()).or_default() += clips;
            }
            for (reason, clips) in &more.refused {
                *row.refused.entry(reason.clone()).or_default() += clips;
            }
        }
    }
}

fn empty(modalities: &[Box<dyn Modality>]) -> Inventory {
    let row = |modality: &dyn Modality| Row {
        modality: modality.name().to_owned(),
        rate: modality.rate(),
        frame: modality.frame().to_owned(),
        ..Row::default()
    };
    Inventory {
        clips: 0,
        modalities: modalities.iter().map(|m| row(m.as_ref())).collect(),
    }
}

/// The inventory of one clip.
pub fn count(clip: &Clip, format: &ClipFormat) -> Inventory {
    let modalities = all(format);
    let mut inventory = empty(&modalities);
    inventory.clips = 1;
    for (modality, row) in modalities.iter().zip(&mut inventory.modalities) {
        let (signal, units) = match modality.measure(clip) {
            Ok(measured) => measured,
            Err(error) => {
                // Without the clip's id, so that equal reasons are counted together.
                let reason = error
                    .to_string()
                    .replace(&format!("clip `{}`: ", clip.id), "");
                row.refused.insert(reason, 1);
                continue;
            }
        };
        if let Some(signal) = &signal {
            let shape: Vec<String> = signal.values.shape().iter().map(usize::to_string).collect();
            row.shapes.insert(shape.join("x"), 1);
        }
        row.statistics.add(signal.as_ref(), &units);
    }
    inventory
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clip::{CAMERA, DEPTH};
    use crate::world::{World, WorldSettings};

    #[test]
    fn counts_do_not_depend_on_how_clips_are_grouped_and_say_what_is_missing() {
        let settings = WorldSettings {
            size: 16,
            ..WorldSettings::default()
        };
        let world = World::new(settings.clone(), 2);
        let mut clips: Vec<Clip> = (0..5).map(|i| world.clip(i)).collect();
        clips[1].remove("gaze");
        clips[2].get_mut(DEPTH).unwrap().metres.fill(f32::NAN);
        clips[3].get_mut(CAMERA).unwrap().valid.fill(false);
        let (mut whole, mut parts) = (
            Counter::new(&settings.format()),
            Counter::new(&settings.format()),
        );
        whole.add(&clips);
        clips.chunks(2).for_each(|some| parts.add(some));
        let inventory = whole.inventory();
        assert_eq!(inventory, parts.inventory());
        assert_eq!(inventory.clips, 5);
        let row = |name: &str| {
            let mut rows = inventory.modalities.iter();
            rows.find(|row| row.modality == name).unwrap()
        };
        assert_eq!(row("gaze").statistics.clips, 4);
        assert_eq!(row("gaze").statistics.without, 1);
        assert!((row("depth").statistics.valid_share() - 0.8).abs() < 0.01);
        assert_eq!(row("depth").statistics.channels[0].unit, "m");
        assert!(row("depth").statistics.channels[0].min > 0.0);
        let red = &row("rgb").statistics.channels[0];
        assert!(red.min >= 0.0 && red.max <= 255.0 && red.mean > 10.0);
        assert_eq!(row("body").shapes["60x21x3"], 5);
        let camera = &row("camera").statistics;
        assert_eq!((camera.clips, camera.without), (4, 1));
    }
}
