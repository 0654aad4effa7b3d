//! Packed batches: the input and target tokens of several samples, one after the other, without padding.
//!
//! Within a sample, tokens stand by modality in the order of the spec and by position within a modality. Attention runs over
//! whole samples in the encoder and over single runs (one modality of one sample) in the decoder.

use super::spec::{Input, MgetSpec};
use crate::masking::Mask;

/// Which tokens stand in a packed sequence, and where.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Sequence {
    /// Rows of each sample.
    pub lengths: Vec<usize>,
    /// Rows of each run (one modality of one sample), empty runs included: `[samples * modalities]`.
    pub runs: Vec<usize>,
    /// Per row: the position within its modality.
    pub positions: Vec<u32>,
    /// Per row: the index of its modality in the spec.
    pub modalities: Vec<u32>,
    /// Per modality of the spec: its rows, ascending.
    pub rows: Vec<Vec<u32>>,
}

impl Sequence {
    /// Packs the positions of each sample, `[samples][modalities][positions]`.
    #[must_use]
    pub fn new<'a>(modalities: usize, samples: impl Iterator<Item = &'a [Vec<u32>]>) -> Self {
        let mut sequence = Self {
            rows: vec![Vec::new(); modalities],
            ..Self::default()
        };
        for sample in samples {
            let start = sequence.positions.len();
            for (modality, positions) in sample.iter().enumerate() {
                let first = sequence.positions.len() as u32;
                sequence.rows[modality].extend(first..first + positions.len() as u32);
                sequence.positions.extend_from_slice(positions);
                sequence
                    .modalities
                    .extend(std::iter::repeat_n(modality as u32, positions.len()));
                sequence.runs.push(positions.len());
            }
            sequence.lengths.push(sequence.positions.len() - start);
        }
        sequence
    }

    /// How many rows there are.
    #[must_use]
    pub fn len(&self) -> usize {
        self.positions.len()
    }

    /// Whether there is no row.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }
}

/// The tokens of one modality of one sample.
#[derive(Debug, Clone, Copy)]
pub enum Content<'a> {
    /// The sample does not have this modality.
    Absent,
    /// One id per position.
    Ids(&'a [u32]),
    /// A clip `[frames, height, width, channels]` of bytes.
    Bytes(&'a [u8]),
    /// A clip `[frames, height, width, channels]` in [-1, 1].
    Floats(&'a [f32]),
}

/// What enters the encoder for one modality, in the order of its rows.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// One id per row.
    Ids(Vec<u32>),
    /// One tubelet per row, `[rows, values]`.
    Tubelets(Vec<f32>),
}

/// The encoder's input.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EncoderInput {
    /// Where the tokens stand.
    pub sequence: Sequence,
    /// Per modality of the spec.
    pub values: Vec<Values>,
}

/// What the decoder predicts.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Targets {
    /// Where the queries stand.
    pub sequence: Sequence,
    /// Per modality of the spec: the true id of each of its rows.
    pub ids: Vec<Vec<u32>>,
}

/// One training batch on the host.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Batch {
    /// The encoder's input.
    pub visible: EncoderInput,
    /// The decoder's queries and their answers.
    pub targets: Targets,
}

/// Why a sample does not fit a model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BatchError {
    /// A modality does not have as many ids or values as the grid or the clip of the spec.
    #[error("sample {sample}, {modality}: {found} values, expected {expected}")]
    Length {
        /// Index of the sample in the batch.
        sample: usize,
        /// The modality's name in the spec.
        modality: String,
        /// Ids of the modality, or values of its clip.
        found: usize,
        /// How many the spec asks for.
        expected: usize,
    },
    /// A token's id is not below the vocabulary.
    #[error(
        "sample {sample}, {modality}: token {token} at position {position} is outside the vocabulary of {vocabulary}"
    )]
    Vocabulary {
        /// Index of the sample in the batch.
        sample: usize,
        /// The modality's name in the spec.
        modality: String,
        /// Position of the token within its modality.
        position: usize,
        /// The token's id.
        token: u32,
        /// How many different tokens the modality has.
        vocabulary: usize,
    },
    /// A mask uses a modality that the sample lacks or holds in another form, or a position beyond its grid.
    #[error("sample {sample}, {modality}: a mask uses positions the sample does not have")]
    Absent {
        /// Index of the sample in the batch.
        sample: usize,
        /// The modality's name in the spec.
        modality: String,
    },
}

impl Batch {
    /// Packs `samples` (each `[modalities of the spec]`) under their masks.
    ///
    /// # Errors
    /// When a sample's content does not have the spec's shape, or holds a token outside the vocabulary.
    pub fn new(
        spec: &MgetSpec,
        samples: &[Vec<Content<'_>>],
        masks: &[Mask],
    ) -> Result<Self, BatchError> {
        Ok(Self {
            visible: EncoderInput::new(
                spec,
                samples,
                masks.iter().map(|mask| mask.input.as_slice()),
            )?,
            targets: Targets::new(
                spec,
                samples,
                masks.iter().map(|mask| mask.target.as_slice()),
            )?,
        })
    }

    /// How many samples there are.
    #[must_use]
    pub fn samples(&self) -> usize {
        self.visible.sequence.lengths.len()
    }
}

impl EncoderInput {
    /// Packs the inputs of each sample.
    ///
    /// # Errors
    /// As [`Batch::new`].
    pub fn new<'a>(
        spec: &MgetSpec,
        samples: &[Vec<Content<'_>>],
        given: impl Iterator<Item = &'a [Vec<u32>]> + Clone,
    ) -> Result<Self, BatchError> {
        let mut values: Vec<Values> = spec
            .modalities
            .iter()
            .enumerate()
            .map(|(index, modality)| {
                let Some(each) = modality.tubelet_values() else {
                    return Values::Ids(Vec::new());
                };
                let count: usize = given.clone().map(|inputs| inputs[index].len()).sum();
                Values::Tubelets(Vec::with_capacity(each * count))
            })
            .collect();
        for (sample, (contents, positions)) in samples.iter().zip(given.clone()).enumerate() {
            for (index, positions) in positions.iter().enumerate() {
                let source = Source {
                    spec,
                    sample,
                    index,
                    content: contents[index],
                };
                match &mut values[index] {
                    Values::Ids(ids) => source.ids(positions, ids)?,
                    Values::Tubelets(tubelets) => source.tubelets(positions, tubelets)?,
                }
            }
        }
        Ok(Self {
            sequence: Sequence::new(spec.modalities.len(), given),
            values,
        })
    }
}

impl Targets {
    /// Packs the targets of each sample.
    ///
    /// # Errors
    /// As [`Batch::new`].
    pub fn new<'a>(
        spec: &MgetSpec,
        samples: &[Vec<Content<'_>>],
        asked: impl Iterator<Item = &'a [Vec<u32>]> + Clone,
    ) -> Result<Self, BatchError> {
        let mut ids = vec![Vec::new(); spec.modalities.len()];
        for (sample, (contents, positions)) in samples.iter().zip(asked.clone()).enumerate() {
            for (index, positions) in positions.iter().enumerate() {
                let source = Source {
                    spec,
                    sample,
                    index,
                    content: contents[index],
                };
                source.ids(positions, &mut ids[index])?;
            }
        }
        Ok(Self {
            sequence: Sequence::new(spec.modalities.len(), asked),
            ids,
        })
    }
}

/// One modality of one sample, on its way into a batch.
struct Source<'a> {
    spec: &'a MgetSpec,
    sample: usize,
    index: usize,
    content: Content<'a>,
}

impl Source<'_> {
    fn name(&self) -> String {
        self.spec.modalities[self.index].name.clone()
    }

    fn absent(&self) -> BatchError {
        BatchError::Absent {
            sample: self.sample,
            modality: self.name(),
        }
    }

    fn expect_length(&self, found: usize, expected: usize) -> Result<(), BatchError> {
        if found == expected {
            return Ok(());
        }
        Err(BatchError::Length {
            sample: self.sample,
            modality: self.name(),
            found,
            expected,
        })
    }

    fn ids(&self, positions: &[u32], into: &mut Vec<u32>) -> Result<(), BatchError> {
        if positions.is_empty() {
            return Ok(());
        }
        let modality = &self.spec.modalities[self.index];
        let (Content::Ids(ids), Some(vocabulary)) = (self.content, modality.vocabulary()) else {
            return Err(self.absent());
        };
        self.expect_length(ids.len(), modality.count())?;
        for position in positions {
            let token = *ids.get(*position as usize).ok_or_else(|| self.absent())?;
            if token as usize >= vocabulary {
                return Err(BatchError::Vocabulary {
                    sample: self.sample,
                    modality: self.name(),
                    position: *position as usize,
                    token,
                    vocabulary,
                });
            }
            into.push(token);
        }
        Ok(())
    }

    /// Tubelets in the order frames, height, width, channels; bytes become [-1, 1].
    fn tubelets(&self, positions: &[u32], into: &mut Vec<f32>) -> Result<(), BatchError> {
        if positions.is_empty() {
            return Ok(());
        }
        let Input::Pixels { clip, tubelet } = self.spec.modalities[self.index].input else {
            return Err(self.absent());
        };
        let [frames, height, width, channels] = clip;
        let expected = frames * height * width * channels;
        let grid = [height / tubelet[1], width / tubelet[2]];
        let row = tubelet[2] * channels;
        for position in positions {
            let position = *position as usize;
            let (t, h, w) = (
                position / (grid[0] * grid[1]),
                position / grid[1] % grid[0],
                position % grid[1],
            );
            for dt in 0..tubelet[0] {
                for dh in 0..tubelet[1] {
                    let line = (t * tubelet[0] + dt) * height + h * tubelet[1] + dh;
                    let start = (line * width + w * tubelet[2]) * channels;
                    match self.content {
                        Content::Bytes(bytes) => {
                            self.expect_length(bytes.len(), expected)?;
                            let bytes =
                                bytes.get(start..start + row).ok_or_else(|| self.absent())?;
                            into.extend(bytes.iter().map(|byte| f32::from(*byte) / 127.5 - 1.0));
                        }
                        Content::Floats(floats) => {
                            self.expect_length(floats.len(), expected)?;
                            into.extend(
                                floats
                                    .get(start..start + row)
                                    .ok_or_else(|| self.absent())?,
                            );
                        }
                        Content::Absent | Content::Ids(_) => return Err(self.absent()),
                    }
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::{ModalitySpec, Positions, Size};
    use super::*;

    fn spec() -> MgetSpec {
        MgetSpec {
            size: Size::default(),
            positions: Positions::Released,
            modalities: vec![
                ModalitySpec::tokens("camera", &[4], 10),
                ModalitySpec::pixels("pixels", [2, 4, 4, 1], [1, 2, 2]),
            ],
        }
    }

    fn mask(input: [&[u32]; 2], target: [&[u32]; 2]) -> Mask {
        Mask {
            input: input.map(<[u32]>::to_vec).to_vec(),
            target: target.map(<[u32]>::to_vec).to_vec(),
        }
    }

    #[test]
    fn samples_are_packed_without_padding() {
        let clip: Vec<f32> = (0..32_u8).map(f32::from).collect();
        let (a, b) = ([1, 2, 3, 4], [5, 6, 7, 8]);
        let samples = [
            vec![Content::Ids(&a), Content::Floats(&clip)],
            vec![Content::Ids(&b), Content::Absent],
        ];
        let masks = [
            mask([&[0, 3], &[6]], [&[1], &[]]),
            mask([&[2], &[]], [&[0, 1], &[]]),
        ];
        let batch = Batch::new(&spec(), &samples, &masks).unwrap();
        let sequence = &batch.visible.sequence;
        assert_eq!(sequence.lengths, [3, 1]);
        assert_eq!(sequence.runs, [2, 1, 1, 0]);
        assert_eq!(sequence.positions, [0, 3, 6, 2]);
        assert_eq!(sequence.modalities, [0, 0, 1, 0]);
        assert_eq!(sequence.rows, [vec![0, 1, 3], vec![2]]);
        assert_eq!(batch.visible.values[0], Values::Ids(vec![1, 4, 7]));
        // Tubelet 6 is frame 1, row 1, column 0 of the 2 x 2 grid.
        assert_eq!(
            batch.visible.values[1],
            Values::Tubelets(vec![24.0, 25.0, 28.0, 29.0])
        );
        assert_eq!(batch.targets.ids[0], [2, 5, 6]);
        assert_eq!(batch.samples(), 2);
    }

    #[test]
    fn wrong_contents_are_named() {
        let masks = [mask([&[0], &[]], [&[1], &[]])];
        let message = |ids: &[u32]| {
            let samples = [vec![Content::Ids(ids), Content::Absent]];
            Batch::new(&spec(), &samples, &masks)
                .unwrap_err()
                .to_string()
        };
        assert!(message(&[10, 0, 0, 0]).contains("token 10 at position 0 is outside"));
        assert!(message(&[0, 0]).contains("2 values, expected 4"));
        let samples = [vec![Content::Absent, Content::Absent]];
        assert!(Batch::new(&spec(), &samples, &masks).is_err());
    }
}
