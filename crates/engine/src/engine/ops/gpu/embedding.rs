//! Rows of a table, and the gradient of the table: of every row that was taken, the sum over where it was taken, in order.
#![allow(unsafe_code)]

use std::collections::BTreeMap;

use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::*;

use super::tables::{lists, upload};
use super::{Kernel, Saved, UNITS, cubes, empty, sides, zeros};

#[derive(Debug)]
pub struct Embedding<'a> {
    pub ids: &'a [u32],
}

#[cube(launch_unchecked)]
fn take(table: &Tensor<f32>, ids: &Tensor<u32>, y: &mut Tensor<f32>, total: u32, width: u32) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let width = width as usize;
    let row = ids[ABSOLUTE_POS / width] as usize;
    y[ABSOLUTE_POS] = table[row * width + ABSOLUTE_POS % width];
}

/// `taken` lists the rows of `dy` of each of `rows`, as [`lists`] lays them out.
#[cube(launch_unchecked)]
fn add_up(
    dy: &Tensor<f32>,
    rows: &Tensor<u32>,
    taken: &Tensor<u32>,
    sums: &mut Tensor<f32>,
    total: u32,
    width: u32,
) {
    if ABSOLUTE_POS >= total as usize {
        terminate!();
    }
    let width = width as usize;
    let list = ABSOLUTE_POS / width;
    let column = ABSOLUTE_POS % width;
    let mut sum = f32::new(0.0);
    let first = taken[list] as usize;
    let last = taken[list + 1] as usize;
    for at in first..last {
        sum += dy[taken[at] as usize * width + column];
    }
    sums[rows[list] as usize * width + column] = sum;
}

impl Kernel for Embedding<'_> {
    fn forward(&self, [table, _]: [&CubeTensor; 2]) -> Saved {
        let [rows, width] = sides(table);
        assert!(
            self.ids.iter().all(|id| (*id as usize) < rows),
            "ids are rows of the table"
        );
        let total = self.ids.len() * width;
        let y = empty(table, &[self.ids.len(), width]);
        // SAFETY: units stay below `total`, the size of `y`, and ids are rows of the table.
        unsafe {
            take::launch_unchecked(
                &table.client,
                cubes(total),
                CubeDim::new_1d(UNITS),
                table.clone().into_tensor_arg(),
                upload(self.ids, table).into_tensor_arg(),
                y.clone().into_tensor_arg(),
                total as u32,
                width as u32,
            );
        }
        Saved::output(y)
    }

    fn backward(
        &self,
        [table, _]: [&CubeTensor; 2],
        _: &Saved,
        dy: CubeTensor,
        _: [bool; 2],
    ) -> [Option<CubeTensor>; 2] {
        let [rows, width] = sides(table);
        let mut taken: BTreeMap<u32, Vec<u32>> = BTreeMap::new();
        for (at, id) in self.ids.iter().enumerate() {
            taken.entry(*id).or_default().push(at as u32);
        }
        let (taken_rows, taken): (Vec<u32>, Vec<Vec<u32>>) = taken.into_iter().unzip();
        let total = taken_rows.len() * width;
        let sums = zeros(table, &[rows, width]);
        // SAFETY: units stay below `total`; lists name rows of `dy`, and each row of `sums` once.
        unsafe {
            add_up::launch_unchecked(
                &table.client,
                cubes(total),
                CubeDim::new_1d(UNITS),
                dy.into_tensor_arg(),
                upload(&taken_rows, table).into_tensor_arg(),
                upload(&lists(&taken), table).into_tensor_arg(),
                sums.clone().into_tensor_arg(),
                total as u32,
                width as u32,
            );
        }
        [Some(sums), None]
    }
}
