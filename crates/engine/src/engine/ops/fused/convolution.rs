//! Factorised causal convolutions over video: a gather of each output row's taps followed by one matrix product. No pass keeps
//! the gathered rows.

use rayon::prelude::*;

use super::super::conv_window::ConvWindow;
use super::super::gemm::{Matrix, Threads, gemm, gemm_into};
use super::{Array, Kernel, Saved};

/// Output rows per task: fixed, so results do not depend on the number of threads.
const ROWS: usize = 512;
/// Partial sums of weight gradients: fixed for the same reason.
const GROUPS: usize = 8;

#[derive(Debug)]
pub struct Convolution {
    pub taps: ConvWindow,
}

impl Kernel for Convolution {
    fn forward(&self, [x, weight, bias]: [&Array; 3]) -> (Array, Saved) {
        let y = Operands::new(x, weight, self.taps).forward(bias.values());
        (y, Saved::default())
    }

    fn backward(
        &self,
        [x, weight, _]: [&Array; 3],
        _: &Saved,
        dy: &Array,
        [want_x, want_weight, want_bias]: [bool; 3],
    ) -> [Option<Array>; 3] {
        let (operands, dy) = (Operands::new(x, weight, self.taps), dy.values());
        [
            want_x.then(|| operands.input_gradient(dy)),
            want_weight.then(|| operands.weight_gradient(dy)),
            want_bias.then(|| operands.bias_gradient(dy)),
        ]
    }
}

/// What the passes compute from.
#[derive(Debug, Clone, Copy)]
struct Operands<'a> {
    /// `[N, C]`.
    x: &'a [f32],
    /// `[O, C * taps]`, channel by tap.
    weight: &'a [f32],
    taps: ConvWindow,
    channels: usize,
    outputs: usize,
}

impl<'a> Operands<'a> {
    fn new(x: &'a Array, weight: &'a Array, taps: ConvWindow) -> Self {
        Self {
            x: x.values(),
            weight: weight.values(),
            taps,
            channels: x.width(),
            outputs: weight.shape()[0],
        }
    }

    /// Values of one output row's taps.
    fn inner(&self) -> usize {
        self.channels * self.taps.count()
    }

    /// The weight as `[O, taps, C]`, the order in which taps are gathered.
    fn by_tap(&self) -> Vec<f32> {
        let (taps, channels) = (self.taps.count(), self.channels);
        let mut out = vec![0.0; self.weight.len()];
        out.par_chunks_mut(self.inner())
            .zip(self.weight.par_chunks(self.inner()))
            .for_each(|(out, weight)| {
                for (tap, out) in out.chunks_exact_mut(channels).enumerate() {
                    for (out, value) in out.iter_mut().zip(weight.iter().skip(tap).step_by(taps)) {
                        *out = *value;
                    }
                }
            });
        out
    }

    fn forward(&self, bias: &[f32]) -> Array {
        let (inner, outputs, rows) = (self.inner(), self.outputs, self.taps.rows_out());
        let weight = self.by_tap();
        let mut y = vec![0.0; rows * outputs];
        y.par_chunks_mut(ROWS * outputs).enumerate().for_each_init(
            Vec::new,
            |columns: &mut Vec<f32>, (block, y)| {
                let count = y.len() / outputs;
                columns.resize(count * inner, 0.0);
                self.taps
                    .gather(self.x, self.channels, block * ROWS, columns);
                gemm(
                    y,
                    Matrix::rows(columns, count, inner),
                    Matrix::rows(&weight, outputs, inner).transposed(),
                );
                for row in y.chunks_exact_mut(outputs) {
                    for (y, bias) in row.iter_mut().zip(bias) {
                        *y += bias;
                    }
                }
            },
        );
        Array::new(y, &[rows, outputs])
    }

    fn input_gradient(&self, dy: &[f32]) -> Array {
        let (inner, outputs, channels) = (self.inner(), self.outputs, self.channels);
        let weight = self.by_tap();
        let units = self.taps.units();
        let parts: Vec<Vec<f32>> = units
            .par_iter()
            .map(|[written, read]| {
                let mut sums = vec![0.0; read.count() * channels];
                let (mut gathered, mut columns) = (Vec::new(), Vec::new());
                for first in (0..written.count()).step_by(ROWS) {
                    let count = ROWS.min(written.count() - first);
                    gathered.clear();
                    for place in first..first + count {
                        gathered.extend_from_slice(&dy[written.row(place) * outputs..][..outputs]);
                    }
                    columns.resize(count * inner, 0.0);
                    gemm(
                        &mut columns,
                        Matrix::rows(&gathered, count, outputs),
                        Matrix::rows(&weight, outputs, inner),
                    );
                    for (place, columns) in (first..).zip(columns.chunks_exact(inner)) {
                        let row = written.row(place);
                        for (tap, part) in columns.chunks_exact(channels).enumerate() {
                            let Some(source) = self.taps.source(row, tap) else {
                                continue;
                            };
                            let sum = &mut sums[read.place(source) * channels..][..channels];
                            for (sum, value) in sum.iter_mut().zip(part) {
                                *sum += value;
                            }
                        }
                    }
                }
                sums
            })
            .collect();
        let mut dx = vec![0.0; self.taps.rows_in() * channels];
        for ([_, read], sums) in units.into_iter().zip(parts) {
            let runs = sums.chunks_exact(read.length * channels);
            for (run, sums) in runs.enumerate() {
                let start = (read.start + run * read.stride) * channels;
                dx[start..start + sums.len()].copy_from_slice(sums);
            }
        }
        Array::new(dx, &[self.taps.rows_in(), channels])
    }

    fn weight_gradient(&self, dy: &[f32]) -> Array {
        let (inner, outputs, taps) = (self.inner(), self.outputs, self.taps.count());
        let rows = self.taps.rows_out();
        let each = rows.div_ceil(GROUPS).max(1);
        let parts: Vec<Vec<f32>> = (0..rows.div_ceil(each))
            .into_par_iter()
            .map(|group| {
                let mut sum = vec![0.0; outputs * inner];
                let mut columns = Vec::new();
                let end = ((group + 1) * each).min(rows);
                let mut first = group * each;
                while first < end {
                    let count = ROWS.min(end - first);
                    columns.resize(count * inner, 0.0);
                    self.taps.gather(self.x, self.channels, first, &mut columns);
                    let dy = Matrix::rows(&dy[first * outputs..], count, outputs);
                    let columns = Matrix::rows(&columns, count, inner);
                    gemm_into(
                        &mut sum,
                        inner,
                        dy.transposed(),
                        columns,
                        1.0,
                        true,
                        Threads::One,
                    );
                    first += count;
                }
                sum
            })
            .collect();
        let mut dw = vec![0.0; outputs * inner];
        dw.par_chunks_mut(inner).enumerate().for_each_init(
            || vec![0.0; inner],
            |by_tap, (output, dw)| {
                by_tap.fill(0.0);
                for part in &parts {
                    for (sum, value) in by_tap.iter_mut().zip(&part[output * inner..]) {
                        *sum += value;
                    }
                }
                for (tap, part) in by_tap.chunks_exact(self.channels).enumerate() {
                    for (channel, value) in part.iter().enumerate() {
                        dw[channel * taps + tap] = *value;
                    }
                }
            },
        );
        Array::new(dw, &[outputs, inner])
    }

    fn bias_gradient(&self, dy: &[f32]) -> Array {
        let mut sum = vec![0.0_f64; self.outputs];
        for row in dy.chunks_exact(self.outputs) {
            for (sum, value) in sum.iter_mut().zip(row) {
                *sum += f64::from(*value);
            }
        }
        let sum = sum.into_iter().map(|value| value as f32).collect();
        Array::new(sum, &[self.outputs])
    }
}
