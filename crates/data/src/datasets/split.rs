//! Which recordings of a data set are for training, which for validation and which for the test: whole recordings, so that no two
//! clips of one stretch of time stand on both sides.

use super::{ClipSource, Excluded, Outcome, ReadError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::sync::Arc;

/// How recordings are divided.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SplitSettings {
    /// The share of recordings for validation, chosen by a hash of their names: a recording stays where it is when others come.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub validation: f64,
    /// The share of recordings for the test.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub test: f64,
    /// These recordings are for validation, whatever the shares say. `P0001_*` stands for all whose names begin so.
    pub validation_recordings: Vec<String>,
    /// These recordings are for the test, whatever the shares say. `P0001_*` stands for all whose names begin so.
    pub test_recordings: Vec<String>,
    /// Recordings for which the data set itself names a split belong there (the lists of HoloAssist); the shares divide the others.
    pub official: bool,
}

impl Default for SplitSettings {
    fn default() -> Self {
        SplitSettings {
            validation: 0.1,
            test: 0.1,
            validation_recordings: Vec::new(),
            test_recordings: Vec::new(),
            official: false,
        }
    }
}

/// Whether an entry of the settings names this recording.
fn names(entry: &str, recording: &str) -> bool {
    match entry.strip_suffix('*') {
        Some(start) => recording.starts_with(start),
        None => entry == recording,
    }
}

impl SplitSettings {
    /// What is wrong with the settings, if anything, as (key, reason).
    pub fn problem(&self) -> Option<(&'static str, String)> {
        for (key, share) in [("validation", self.validation), ("test", self.test)] {
            if !(0.0..=1.0).contains(&share) {
                return Some((key, format!("{share} is not a share between 0 and 1")));
            }
        }
        if self.validation + self.test > 1.0 {
            return Some(("test", "the shares exceed the whole".to_owned()));
        }
        let twice = |name: &&String| self.validation_recordings.contains(name);
        let twice = self.test_recordings.iter().find(twice)?;
        let reason = format!("`{twice}` is in `validation_recordings` too");
        Some(("test_recordings", reason))
    }

    /// The split of a recording that is not one of chance: named in the settings, or by whoever published it.
    fn fixed(&self, recording: &str, official: Option<&'static str>) -> Option<&'static str> {
        let named = |list: &[String]| list.iter().any(|entry| names(entry, recording));
        if named(&self.test_recordings) {
            return Some("test");
        }
        if named(&self.validation_recordings) {
            return Some("validation");
        }
        official.filter(|_| self.official)
    }

    /// The split of a recording; `official` is what whoever published it says.
    pub fn of(&self, recording: &str, official: Option<&'static str>) -> &'static str {
        if let Some(split) = self.fixed(recording, official) {
            return split;
        }
        let hash = blake3::hash(recording.as_bytes());
        let mut first = [0; 8];
        first.copy_from_slice(&hash.as_bytes()[..8]);
        let place = u64::from_le_bytes(first) as f64 / u64::MAX as f64;
        if place < self.test {
            "test"
        } else if place < self.test + self.validation {
            "validation"
        } else {
            "train"
        }
    }
}

/// Gives each of the `asked` splits its clips: at most as many as are asked for, spread over its recordings. A single split gets
/// everything; a single recording is cut into consecutive parts, the test at its end.
///
/// # Errors
/// When a named recording does not exist.
pub fn divide(
    source: &dyn ClipSource,
    settings: &SplitSettings,
    asked: &[(&'static str, u64)],
) -> Result<Vec<(&'static str, Vec<usize>)>, ReadError> {
    let recordings = source.recordings();
    let official = source.splits();
    let named = settings
        .validation_recordings
        .iter()
        .chain(&settings.test_recordings);
    for name in named {
        if !name.ends_with('*') && !recordings.iter().any(|(known, _)| known == name) {
            let some: Vec<&str> = recordings.iter().take(8).map(|(n, _)| n.as_str()).collect();
            return Err(ReadError::Settings(format!(
                "`{}` has no recording `{name}`; it has {}{}",
                source.name(),
                some.join(", "),
                if recordings.len() > 8 { ", ..." } else { "" }
            )));
        }
    }
    let mut parts: Vec<(&'static str, Vec<usize>)> =
        asked.iter().map(|(name, _)| (*name, Vec::new())).collect();
    let mut give = |split: &str, clips: Range<usize>| {
        if let Some((_, list)) = parts.iter_mut().find(|(name, _)| *name == split) {
            list.extend(clips);
        }
    };
    match (asked, recordings.as_slice()) {
        ([(only, _)], _) => give(only, 0..source.len()),
        (_, [(name, all)]) if settings.fixed(name, official.get(name).copied()).is_none() => {
            let cut = |share: f64| all.start + (all.len() as f64 * share).round() as usize;
            let (a, b) = (
                cut(1.0 - settings.validation - settings.test),
                cut(1.0 - settings.test),
            );
            give("train", all.start..a);
            give("validation", a..b);
            give("test", b..all.end);
        }
        _ => {
            for (name, clips) in recordings {
                let official = official.get(&name).copied();
                give(settings.of(&name, official), clips);
            }
        }
    }
    for ((_, list), (_, most)) in parts.iter_mut().zip(asked) {
        let (there, most) = (list.len(), *most as usize);
        if there > most {
            *list = (0..most).map(|k| list[k * there / most]).collect();
        }
    }
    Ok(parts)
}

/// Some clips of a source.
pub struct Chosen {
    source: Arc<dyn ClipSource>,
    indices: Vec<usize>,
}

impl Chosen {
    /// The clips `indices` of `source`, in this order.
    pub fn new(source: Arc<dyn ClipSource>, indices: Vec<usize>) -> Self {
        Chosen { source, indices }
    }
}

impl ClipSource for Chosen {
    fn name(&self) -> &str {
        self.source.name()
    }

    fn len(&self) -> usize {
        self.indices.len()
    }

    fn modalities(&self) -> Vec<String> {
        self.source.modalities()
    }

    fn excluded(&self) -> Vec<Excluded> {
        self.source.excluded()
    }

    fn notes(&self) -> Vec<(String, usize)> {
        self.source.notes()
    }

    fn decoders(&self) -> Vec<(String, usize)> {
        self.source.decoders()
    }

    fn lost(&self, index: usize) -> Vec<String> {
        let inside = self.indices.get(index);
        inside.map_or_else(Vec::new, |inside| self.source.lost(*inside))
    }

    fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
        let inside = self.indices.get(index);
        let inside = inside.ok_or_else(|| ReadError::OutOfRange {
            source_name: self.name().to_owned(),
            index,
            len: self.len(),
        })?;
        self.source.clip(*inside)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeMap;

    /// Recordings of ten clips each.
    struct Fake(Vec<String>);

    impl Fake {
        fn of(count: usize) -> Self {
            Fake((0..count).map(|i| format!("take_{i}")).collect())
        }
    }

    impl ClipSource for Fake {
        fn name(&self) -> &'static str {
            "fake"
        }
        fn len(&self) -> usize {
            10 * self.0.len()
        }
        fn modalities(&self) -> Vec<String> {
            Vec::new()
        }
        fn recordings(&self) -> Vec<(String, Range<usize>)> {
            let name = |(i, name): (usize, &String)| (name.clone(), 10 * i..10 * i + 10);
            self.0.iter().enumerate().map(name).collect()
        }
        fn clip(&self, _index: usize) -> Result<Outcome, ReadError> {
            Err(ReadError::Settings(String::new()))
        }
    }

    const ALL: [(&str, u64); 3] = [("train", 100_000), ("validation", 100_000), ("test", 25)];

    #[test]
    fn recordings_stay_whole_and_where_they_are_when_others_come() {
        let settings = SplitSettings::default();
        let few = divide(&Fake::of(100), &settings, &ALL).unwrap();
        let more = divide(&Fake::of(200), &settings, &ALL).unwrap();
        for (few, more) in few.iter().zip(&more).take(2) {
            assert!(few.1.len() >= 20, "{}: {}", few.0, few.1.len());
            assert_eq!(few.1.len() % 10, 0);
            assert!(few.1.iter().all(|clip| more.1.contains(clip)));
        }
        assert!(few[0].1.len() > 600);
        // At most as many as asked for, from all over.
        assert_eq!(few[2].1.len(), 25);
        assert!(few[2].1[24] - few[2].1[0] > 100);
        let together: usize = divide(&Fake::of(100), &settings, &[ALL[0], ALL[1], ("test", 9999)])
            .unwrap()
            .iter()
            .map(|(_, clips)| clips.len())
            .sum();
        assert_eq!(together, 1000);
    }

    #[test]
    fn named_recordings_are_held_out_and_a_wrong_name_is_an_error() {
        let mut settings = SplitSettings {
            validation: 0.0,
            test: 0.0,
            test_recordings: vec!["take_3".to_owned()],
            ..SplitSettings::default()
        };
        let parts = divide(&Fake::of(5), &settings, &ALL).unwrap();
        assert_eq!(parts[2].1, (30..40).collect::<Vec<_>>());
        assert_eq!((parts[0].1.len(), parts[1].1.len()), (40, 0));
        settings.test_recordings = vec!["take_9".to_owned()];
        let message = divide(&Fake::of(5), &settings, &ALL)
            .unwrap_err()
            .to_string();
        assert!(
            message.contains("take_9") && message.contains("take_4"),
            "{message}"
        );
    }

    #[test]
    fn participants_and_official_lists_decide_before_chance() {
        struct Listed(Fake);
        impl ClipSource for Listed {
            fn name(&self) -> &str {
                self.0.name()
            }
            fn len(&self) -> usize {
                self.0.len()
            }
            fn modalities(&self) -> Vec<String> {
                Vec::new()
            }
            fn recordings(&self) -> Vec<(String, Range<usize>)> {
                self.0.recordings()
            }
            fn splits(&self) -> BTreeMap<String, &'static str> {
                BTreeMap::from([
                    ("take_0".to_owned(), "validation"),
                    ("take_10".to_owned(), "test"),
                ])
            }
            fn clip(&self, index: usize) -> Result<Outcome, ReadError> {
                self.0.clip(index)
            }
        }
        let mut settings = SplitSettings {
            validation: 0.0,
            test: 0.0,
            test_recordings: vec!["take_1*".to_owned()],
            official: true,
            ..SplitSettings::default()
        };
        let parts = divide(&Listed(Fake::of(12)), &settings, &ALL).unwrap();
        let counts = |parts: &[(&str, Vec<usize>)]| [0, 1, 2].map(|k| parts[k].1.len());
        // take_1, take_10 and take_11 by name, take_0 by list.
        assert_eq!(counts(&parts), [80, 10, 25]);
        settings.official = false;
        let parts = divide(&Listed(Fake::of(12)), &settings, &ALL).unwrap();
        assert_eq!(counts(&parts), [90, 0, 25]);
        // A single recording that is listed is not cut in time.
        settings.official = true;
        let parts = divide(&Listed(Fake::of(1)), &settings, &ALL).unwrap();
        assert_eq!(counts(&parts), [0, 10, 0]);
    }

    #[test]
    fn one_split_gets_everything_and_one_recording_is_cut_in_time() {
        let settings = SplitSettings::default();
        let parts = divide(&Fake::of(3), &settings, &[("test", 1000)]).unwrap();
        assert_eq!(parts[0].1.len(), 30);
        let parts = divide(&Fake::of(1), &settings, &ALL).unwrap();
        let lists: Vec<&[usize]> = parts.iter().map(|(_, clips)| clips.as_slice()).collect();
        assert_eq!(lists, [&[0, 1, 2, 3, 4, 5, 6, 7][..], &[8], &[9]]);
    }
}
