//! How modalities enter and leave the model.
//!
//! A visible token is its row of the modality's table (or its tubelet through one linear map) plus its place: a fixed position
//! code and the modality's learned vector. A decoder query is the mask token plus its positional embedding. The output matrix of a modality is
//! the decoder's own token table; the place is shared by encoder and decoder.

use super::batch::{EncoderInput, Sequence, Values};
use super::positions;
use super::spec::{MgetSpec, SpecError};
use crate::engine::ops::{embedding, linear_in};
use crate::engine::parameters::{Kind, VisitMut, join};
use crate::engine::{Initialise, Parameter, Parameters, Precision, Tensor};

/// The encoder's side of every modality, and the places.
#[derive(Debug, Clone)]
pub(super) struct Embeddings {
    modalities: Vec<Modality>,
    /// Distinct position tables, one below the other: `[rows, D]`.
    positions: Parameter,
    /// Per modality: its first row in `positions`.
    offsets: Vec<u32>,
    width: usize,
    precision: Precision,
}

#[derive(Debug, Clone)]
struct Modality {
    name: String,
    /// `[D]`.
    mod_emb: Parameter,
    content: Content,
}

#[derive(Debug, Clone)]
enum Content {
    /// `[V, D]`.
    Table(Parameter),
    /// `[D, P]`.
    Tubelets(Parameter),
}

impl Content {
    fn name(&self) -> &'static str {
        match self {
            Self::Table(_) => "token_emb.weight",
            Self::Tubelets(_) => "proj.weight",
        }
    }
}

impl Parameters for Embeddings {
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter)) {
        for modality in &self.modalities {
            let path = join(path, &modality.name);
            visitor(&join(&path, "mod_emb"), &modality.mod_emb);
            let (Content::Table(parameter) | Content::Tubelets(parameter)) = &modality.content;
            visitor(&join(&path, modality.content.name()), parameter);
        }
    }

    fn visit_mut(&mut self, path: &str, visitor: &mut VisitMut<'_>) {
        for modality in &mut self.modalities {
            let path = join(path, &modality.name);
            visitor(&join(&path, "mod_emb"), &mut modality.mod_emb);
            let name = modality.content.name();
            let (Content::Table(parameter) | Content::Tubelets(parameter)) = &mut modality.content;
            visitor(&join(&path, name), parameter);
        }
    }
}

impl Embeddings {
    pub(super) fn new(spec: &MgetSpec, init: &Initialise<'_>) -> Result<Self, SpecError> {
        let width = spec.size.width;
        let mut grids: Vec<(Vec<usize>, u32)> = Vec::new();
        let mut table = Vec::new();
        let mut offsets = Vec::new();
        let mut modalities = Vec::new();
        for modality in &spec.modalities {
            let grid = modality.grid();
            let offset =
                if let Some((_, offset)) = grids.iter().find(|(other, _)| *other == grid) {
                    *offset
                } else {
                    let offset = (table.len() / width) as u32;
                    table.extend(positions::table(&grid, width, spec.positions).ok_or_else(
                        || SpecError::NoTable {
                            modality: modality.name.clone(),
                        },
                    )?);
                    grids.push((grid, offset));
                    offset
                };
            offsets.push(offset);
            let init = init.at(&modality.name);
            let content = match (modality.vocabulary(), modality.tubelet_values()) {
                (None, Some(values)) => {
                    Content::Tubelets(init.xavier("proj.weight", &[width, values], values, width))
                }
                (vocabulary, _) => {
                    let rows = vocabulary.unwrap_or(0);
                    Content::Table(init.normal("token_emb.weight", &[rows, width], 0.02))
                }
            };
            modalities.push(Modality {
                name: modality.name.clone(),
                mod_emb: init.normal("mod_emb", &[width], 0.02),
                content,
            });
        }
        let rows = table.len() / width;
        Ok(Self {
            modalities,
            positions: Parameter::new(Kind::Buffer, table, &[rows, width], init.compute().device()),
            offsets,
            width,
            precision: init.compute().precision(),
        })
    }

    /// What the visible tokens say: `[N, D]`.
    pub(super) fn token_embedding(&self, visible: &EncoderInput) -> Tensor<2> {
        // Modality by modality first, then each row to where it stands in the batch.
        let mut parts = Vec::new();
        let mut order = vec![0_u32; visible.sequence.len()];
        let mut next = 0;
        for (index, values) in visible.values.iter().enumerate() {
            let rows = &visible.sequence.rows[index];
            if rows.is_empty() {
                continue;
            }
            for row in rows {
                order[*row as usize] = next;
                next += 1;
            }
            parts.push(match (&self.modalities[index].content, values) {
                (Content::Table(table), Values::Ids(ids)) => embedding(table.tensor(), ids),
                (Content::Tubelets(map), Values::Tubelets(values)) => {
                    let tubelets_NP = self.rows_of(values, map.shape()[1]);
                    linear_in(self.precision, tubelets_NP, map.tensor(), None)
                }
                _ => unreachable!("batches are built from the same spec"),
            });
        }
        let in_order = order
            .iter()
            .enumerate()
            .all(|(row, from)| row == *from as usize);
        let x_ND = Tensor::cat(parts, 0);
        if in_order {
            x_ND
        } else {
            embedding(x_ND, &order)
        }
    }

    /// Where the tokens stand, `[rows, D]`: position code plus the modality's vector.
    pub(super) fn positional_embedding(&self, sequence: &Sequence) -> Tensor<2> {
        let rows: Vec<u32> = sequence
            .positions
            .iter()
            .zip(&sequence.modalities)
            .map(|(position, modality)| self.offsets[*modality as usize] + position)
            .collect();
        let vectors: Vec<Tensor<2>> = self
            .modalities
            .iter()
            .map(|modality| modality.mod_emb.reshaped([1, self.width]))
            .collect();
        embedding(self.positions.tensor(), &rows)
            + embedding(Tensor::cat(vectors, 0), &sequence.modalities)
    }

    fn rows_of(&self, values: &[f32], width: usize) -> Tensor<2> {
        let rows = values.len() / width;
        let device = self.positions.untracked().device();
        Tensor::from_data(
            burn::tensor::TensorData::new(values.to_vec(), [rows, width]),
            &device,
        )
    }
}

/// The output matrices: the decoder's token tables.
#[derive(Debug, Clone)]
pub(super) struct Heads {
    /// Per modality of the spec; raw video has none.
    tables: Vec<Option<(String, Parameter)>>,
    precision: Precision,
}

impl Parameters for Heads {
    fn visit(&self, path: &str, visitor: &mut dyn FnMut(&str, &Parameter)) {
        for (name, table) in self.tables.iter().flatten() {
            visitor(&join(&join(path, name), "token_emb.weight"), table);
        }
    }

    fn visit_mut(&mut self, path: &str, visitor: &mut VisitMut<'_>) {
        for (name, table) in self.tables.iter_mut().flatten() {
            visitor(&join(&join(path, name), "token_emb.weight"), table);
        }
    }
}

impl Heads {
    pub(super) fn new(spec: &MgetSpec, init: &Initialise<'_>) -> Self {
        let width = spec.size.width;
        let tables = spec
            .modalities
            .iter()
            .map(|modality| {
                let vocabulary = modality.vocabulary()?;
                // The reference initialises this table as the output matrix it is tied to.
                let table = init.at(&modality.name).xavier(
                    "token_emb.weight",
                    &[vocabulary, width],
                    width,
                    vocabulary,
                );
                Some((modality.name.clone(), table))
            })
            .collect();
        Self {
            tables,
            precision: init.compute().precision(),
        }
    }

    /// What products with the tables are computed in.
    pub(super) fn precision(&self) -> Precision {
        self.precision
    }

    /// The output matrix of a modality, `[V, D]`.
    pub(super) fn table(&self, modality: usize) -> Option<Tensor<2>> {
        self.tables
            .get(modality)?
            .as_ref()
            .map(|(_, table)| table.tensor())
    }

    /// The rows of `y_MD` that belong to a modality.
    pub(super) fn rows(y_MD: &Tensor<2>, rows: &[u32]) -> Tensor<2> {
        let [all, _] = y_MD.dims();
        if rows.len() == all {
            return y_MD.clone();
        }
        embedding(y_MD.clone(), rows)
    }

    /// The logits of a modality's rows, `[rows, V]`.
    pub(super) fn logits(
        &self,
        y_MD: &Tensor<2>,
        asked: &Sequence,
        modality: usize,
    ) -> Option<Tensor<2>> {
        let rows = asked.rows.get(modality)?;
        if rows.is_empty() {
            return None;
        }
        Some(linear_in(
            self.precision,
            Self::rows(y_MD, rows),
            self.table(modality)?,
            None,
        ))
    }
}
