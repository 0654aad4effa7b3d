//! Cross-entropy of logits `x table^T`, some rows at a time: the logits of all rows never exist together.
#![allow(unsafe_code)]

use burn::backend::ops::FloatTensorOps;
use burn::tensor::{FloatDType, Slice};
use burn_cubecl::CubeBackend;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use super::super::super::Precision;
use super::tables::upload;
use super::{Kernel, Saved, UNITS, cubes, dense, empty, sides};

/// Logits that exist at once: 64 MiB, which every device can bind.
const LOGITS: usize = 16 << 20;
/// Units that share a row.
const SHARED_BY: u32 = 128;

#[derive(Debug)]
pub struct TiedCrossEntropy<'a> {
    pub targets: &'a [u32],
    pub precision: Precision,
}

/// A cube per row: each unit goes over every so many classes, then the first adds them up.
#[cube(launch_unchecked)]
fn nats(
    logits: &Tensor<f32>,
    targets: &Tensor<u32>,
    losses: &mut Tensor<f32>,
    normalisers: &mut Tensor<f32>,
    first: u32,
    classes: u32,
    #[comptime] units: usize,
) {
    let row = CUBE_POS_X as usize;
    let unit = UNIT_POS_X as usize;
    let classes = classes as usize;
    let mut mosts = Shared::<[f32]>::new_slice(units);
    let mut sums = Shared::<[f32]>::new_slice(units);
    let mut most = f32::new(-3.0e38);
    let mut sum = f32::new(0.0);
    let mut class = unit;
    while class < classes {
        let score = logits[row * classes + class];
        if score > most {
            sum = sum * (most - score).exp() + 1.0;
            most = score;
        } else {
            sum += (score - most).exp();
        }
        class += units;
    }
    mosts[unit] = most;
    sums[unit] = sum;
    sync_cube();
    if unit == 0 {
        for other in 0..units {
            if mosts[other] > most {
                most = mosts[other];
            }
        }
        sum = f32::new(0.0);
        for other in 0..units {
            sum += sums[other] * (mosts[other] - most).exp();
        }
        let normaliser = most + sum.ln();
        let at = first as usize + row;
        normalisers[at] = normaliser;
        losses[at] = normaliser - logits[row * classes + targets[at] as usize];
    }
}

/// Logits become their gradients.
#[cube(launch_unchecked)]
fn slopes(
    logits: &mut Tensor<f32>,
    targets: &Tensor<u32>,
    normalisers: &Tensor<f32>,
    dy: &Tensor<f32>,
    first: u32,
    classes: u32,
    total: u32,
) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let classes = classes as usize;
    let at = first as usize + ABSOLUTE_POS / classes;
    let mut share = (logits[ABSOLUTE_POS] - normalisers[at]).exp();
    if targets[at] as usize == ABSOLUTE_POS % classes {
        share -= 1.0;
    }
    logits[ABSOLUTE_POS] = share * dy[at];
}

fn rows_of(x: &CubeTensor, rows: &std::ops::Range<usize>) -> CubeTensor {
    let [_, width] = sides(x);
    let slices = [Slice::from(rows.clone()), Slice::from(0..width)];
    dense(CubeBackend::float_slice(x.clone(), &slices))
}

impl TiedCrossEntropy<'_> {
    fn product(&self, a: CubeTensor, b: CubeTensor) -> CubeTensor {
        if self.precision == Precision::F32 {
            return CubeBackend::float_matmul(a, b);
        }
        let [a, b] = [a, b].map(|operand| CubeBackend::float_cast(operand, FloatDType::BF16));
        CubeBackend::float_cast(CubeBackend::float_matmul(a, b), FloatDType::F32)
    }

    /// Calls `visit` with some rows and their logits at a time.
    fn by_rows(
        &self,
        [x, table]: [&CubeTensor; 2],
        mut visit: impl FnMut(&std::ops::Range<usize>, CubeTensor, CubeTensor),
    ) {
        let [classes, _] = sides(table);
        let rows = self.targets.len();
        let step = (LOGITS / classes.max(1)).clamp(1, rows.max(1));
        for start in (0..rows).step_by(step) {
            let range = start..(start + step).min(rows);
            let part = rows_of(x, &range);
            let transposed = CubeBackend::float_transpose(table.clone());
            let logits = dense(self.product(part.clone(), transposed));
            visit(&range, part, logits);
        }
    }
}

impl Kernel for TiedCrossEntropy<'_> {
    fn forward(&self, inputs: [&CubeTensor; 2]) -> Saved {
        let [x, table] = inputs;
        let [classes, _] = sides(table);
        let targets = upload(self.targets, x);
        let losses = empty(x, &[self.targets.len()]);
        let normalisers = empty(x, &[self.targets.len()]);
        self.by_rows(inputs, |rows, _, logits| {
            // SAFETY: a cube per row of `logits`, whose targets are classes (the front door has checked).
            unsafe {
                nats::launch_unchecked(
                    &x.client,
                    CubeCount::Static(rows.len() as u32, 1, 1),
                    CubeDim::new_1d(SHARED_BY),
                    logits.into_tensor_arg(),
                    targets.clone().into_tensor_arg(),
                    losses.clone().into_tensor_arg(),
                    normalisers.clone().into_tensor_arg(),
                    rows.start as u32,
                    classes as u32,
                    SHARED_BY as usize,
                );
            }
        });
        Saved {
            output: losses,
            normalisers: Some(normalisers),
        }
    }

    fn backward(
        &self,
        inputs: [&CubeTensor; 2],
        saved: &Saved,
        dy: CubeTensor,
        wanted: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let [x, table] = inputs;
        let [classes, _] = sides(table);
        let targets = upload(self.targets, x);
        let normalisers = saved
            .normalisers
            .as_ref()
            .expect("forward of cross-entropy leaves them");
        let (mut dx, mut dtable) = (Vec::new(), None);
        self.by_rows(inputs, |rows, part, logits| {
            let total = rows.len() * classes;
            // SAFETY: units stay below the size of `logits`, and each changes its own element.
            unsafe {
                slopes::launch_unchecked(
                    &x.client,
                    cubes(total),
                    CubeDim::new_1d(UNITS),
                    logits.clone().into_tensor_arg(),
                    targets.clone().into_tensor_arg(),
                    normalisers.clone().into_tensor_arg(),
                    dy.clone().into_tensor_arg(),
                    rows.start as u32,
                    classes as u32,
                    total as u32,
                );
            }
            if wanted[0] {
                dx.push(self.product(logits.clone(), table.clone()));
            }
            if wanted[1] {
                let more = self.product(CubeBackend::float_transpose(logits), part);
                dtable = Some(match dtable.take() {
                    Some(sum) => CubeBackend::float_add(sum, more),
                    None => more,
                });
            }
        });
        let dx = (!dx.is_empty()).then(|| CubeBackend::float_cat(dx, 0));
        [dx, dtable]
    }
}
