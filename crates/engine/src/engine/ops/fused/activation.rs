//! GELU, SwiGLU and the hyperbolic tangent, element by element; backward recomputes from the inputs, of the last from the output.
// Vector instructions reach only what is inlined.
#![allow(clippy::inline_always)]
#![allow(unsafe_code)]

use rayon::prelude::*;

use super::{Array, Kernel, Saved, vector, written};

/// Elements per task.
const ELEMENTS: usize = 8192;

/// `y[i] = f(i-th values of the inputs)` for all elements, in parallel.
fn map<const N: usize>(inputs: [&[f32]; N], f: impl Fn([f32; N]) -> f32 + Sync) -> Vec<f32> {
    let length = inputs[0].len();
    // SAFETY: the tasks are all of `y`, and each writes all of its part.
    unsafe {
        written(length, |y| {
            y.par_chunks_mut(ELEMENTS)
                .enumerate()
                .for_each(|(task, y)| {
                    let inputs = inputs.map(|x| &x[task * ELEMENTS..]);
                    vector::vectorised(
                        #[inline(always)]
                        || {
                            // An index that has to be checked keeps a loop from becoming vector instructions.
                            let inputs = inputs.map(|x| &x[..y.len()]);
                            for (i, y) in y.iter_mut().enumerate() {
                                y.write(f(inputs.map(|x| x[i])));
                            }
                        },
                    );
                });
        })
    }
}

/// `x Phi(x)`.
#[derive(Debug)]
pub struct Gelu;

/// The normal distribution function.
#[inline(always)]
fn phi(x: f32) -> f32 {
    0.5 * (1.0 + vector::erf(x * std::f32::consts::FRAC_1_SQRT_2))
}

impl Kernel for Gelu {
    fn forward(&self, [x, _, _]: [&Array; 3]) -> (Array, Saved) {
        let y = map(
            [x.values()],
            #[inline(always)]
            |[x]| x * phi(x),
        );
        (Array::new(y, &x.shape()), Saved::default())
    }

    fn backward(
        &self,
        [x, _, _]: [&Array; 3],
        _: &Saved,
        dy: &Array,
        _: [bool; 3],
    ) -> [Option<Array>; 3] {
        /// `1 / sqrt(2 pi)`.
        const DENSITY: f32 = 0.398_942_3;
        let dx = map(
            [x.values(), dy.values()],
            #[inline(always)]
            |[x, dy]| dy * (phi(x) + x * DENSITY * vector::exp(-0.5 * x * x)),
        );
        [Some(Array::new(dx, &x.shape())), None, None]
    }
}

/// The hyperbolic tangent.
#[derive(Debug)]
pub struct Tanh;

impl Kernel for Tanh {
    /// Saves the output.
    fn forward(&self, [x, _, _]: [&Array; 3]) -> (Array, Saved) {
        let y = map(
            [x.values()],
            #[inline(always)]
            |[x]| vector::tanh(x),
        );
        let y = Array::new(y, &x.shape());
        let saved = Saved {
            output: Some(y.clone()),
            ..Saved::default()
        };
        (y, saved)
    }

    fn backward(
        &self,
        [x, _, _]: [&Array; 3],
        saved: &Saved,
        dy: &Array,
        _: [bool; 3],
    ) -> [Option<Array>; 3] {
        let output = saved.output.as_ref().expect("forward saves it");
        let dx = map(
            [output.values(), dy.values()],
            #[inline(always)]
            |[y, dy]| dy * (1.0 - y * y),
        );
        [Some(Array::new(dx, &x.shape())), None, None]
    }
}

/// `silu(gate) * value`.
#[derive(Debug)]
pub struct SwiGlu;

impl Kernel for SwiGlu {
    fn forward(&self, [gate, value, _]: [&Array; 3]) -> (Array, Saved) {
        let y = map(
            [gate.values(), value.values()],
            #[inline(always)]
            |[gate, value]| gate * vector::sigmoid(gate) * value,
        );
        (Array::new(y, &gate.shape()), Saved::default())
    }

    fn backward(
        &self,
        [gate, value, _]: [&Array; 3],
        _: &Saved,
        dy: &Array,
        _: [bool; 3],
    ) -> [Option<Array>; 3] {
        let length = gate.values().len();
        let mut dvalue = Vec::with_capacity(length);
        // SAFETY: the tasks are all of both gradients, which are as long as what they are of, and each writes all of its parts.
        let dgate = unsafe {
            let dgate = written(length, |dgate| {
                let dvalue = &mut dvalue.spare_capacity_mut()[..length];
                dgate
                    .par_chunks_mut(ELEMENTS)
                    .zip(dvalue.par_chunks_mut(ELEMENTS))
                    .zip(gate.values().par_chunks(ELEMENTS))
                    .zip(value.values().par_chunks(ELEMENTS))
                    .zip(dy.values().par_chunks(ELEMENTS))
                    .for_each(|((((dgate, dvalue), gate), value), dy)| {
                        vector::vectorised(
                            #[inline(always)]
                            || {
                                let length = dgate.len();
                                let dvalue = &mut dvalue[..length];
                                let (gate, value, dy) =
                                    (&gate[..length], &value[..length], &dy[..length]);
                                for i in 0..length {
                                    let s = vector::sigmoid(gate[i]);
                                    let slope = dy[i] * value[i] * s;
                                    dgate[i].write(slope * (1.0 + gate[i] * (1.0 - s)));
                                    dvalue[i].write(dy[i] * gate[i] * s);
                                }
                            },
                        );
                    });
            });
            dvalue.set_len(length);
            dgate
        };
        let shape = gate.shape();
        [
            Some(Array::new(dgate, &shape)),
            Some(Array::new(dvalue, &shape)),
            None,
        ]
    }
}
