//! A product on one thread: blocks that fit the caches, packed so that tiles read them from end to end.
//!
//! `b` is cut into panels two registers wide, which are copied ("packed") before use, unless so few rows are computed that copying
//! costs more than it saves. `a` is read where it lies, unless its lines fall into the same places of the cache.

use std::cell::RefCell;

use super::tile::{Onto, Strip, Tile};
use super::{Kernels, Operand};

/// Inner length of a block, at most. Sums are rounded where blocks meet, so this is one of the two things that decide the bits of a
/// product; the other is the order within a chain.
const INNER: usize = 512;
/// Columns of a block of `b`: with [`INNER`], 2 MiB.
const COLUMNS: usize = 1024;
/// Rows of a block of `a`: with [`INNER`], a quarter of the second-level cache.
const ROWS: usize = 128;
/// Values between lines of `a` that fall into the same place of the first-level cache.
const SAME_PLACE: usize = 1024;
/// Fewer rows than these, and `b` is read where it lies, if its rows are dense.
const PACK_B_FROM: usize = 42;

/// A product on one thread; `c` is row-major.
#[derive(Debug, Clone, Copy)]
pub(super) struct Product {
    pub rows: usize,
    pub columns: usize,
    pub inner: usize,
    pub a: Operand,
    pub b: Operand,
    pub c: *mut f32,
    pub c_row: usize,
    pub alpha: f32,
    pub onto: Onto,
    /// The whole product, of which this may be a share, is one row of `a` by columns of `b` that lie in one piece.
    pub single_row: bool,
}

thread_local! {
    static PACKED: RefCell<[Vec<f32>; 2]> = const { RefCell::new([Vec::new(), Vec::new()]) };
}

/// The inner length of all blocks but the last: equal shares of at most [`INNER`], in whole cache lines.
fn block_of(inner: usize) -> usize {
    inner
        .div_ceil(inner.div_ceil(INNER).max(1))
        .next_multiple_of(16)
}

/// The start of `length` values in whole cache lines.
fn room(values: &mut Vec<f32>, length: usize) -> *mut f32 {
    const LINE: usize = 16;
    if values.len() < length + LINE {
        // Grown without a copy: nothing in it is kept.
        *values = Vec::new();
        *values = vec![0.0; length + LINE];
    }
    let start = values.as_mut_ptr();
    let skipped = start.align_offset(64).min(LINE);
    start.wrapping_add(skipped)
}

impl Product {
    /// Computes it.
    ///
    /// # Safety
    /// The processor has the instructions of `kernels`; the operands can be read and `c` written at all rows and columns, by nobody
    /// else meanwhile; rows of `a` or its columns are neighbours, and so are those of `b`.
    pub unsafe fn run(&self, kernels: &Kernels) {
        if self.single_row {
            // SAFETY: by the caller's promise.
            return unsafe { (kernels.row)(&self.strip()) };
        }
        if self.inner == 1 && self.b.column == 1 {
            // SAFETY: by the caller's promise.
            return unsafe { (kernels.outer)(&self.strip()) };
        }
        PACKED.with_borrow_mut(|[a, b]| {
            let block = block_of(self.inner);
            let rows = self.rows.min(ROWS + kernels.rows);
            let columns = self
                .columns
                .min(COLUMNS)
                .next_multiple_of(2 * kernels.lanes);
            // Beyond a panel's end, a register may be written whole.
            let a = room(a, (rows + kernels.lanes) * block);
            let b = room(b, (columns + kernels.lanes) * block);
            let mut column = 0;
            while column < self.columns {
                let columns = COLUMNS.min(self.columns - column);
                let mut inner = 0;
                loop {
                    let length = block.min(self.inner - inner);
                    let part = Part {
                        column,
                        columns,
                        inner,
                        length,
                    };
                    // SAFETY: the part lies in the product; the packed blocks have the room it needs.
                    unsafe { self.part(kernels, part, a, b) };
                    inner += length;
                    if inner >= self.inner {
                        break;
                    }
                }
                column += columns;
            }
        });
    }

    fn strip(&self) -> Strip {
        Strip {
            rows: self.rows,
            columns: self.columns,
            inner: self.inner,
            a: self.a.start,
            a_row: self.a.row,
            b: self.b.start,
            b_column: self.b.column,
            c: self.c,
            c_row: self.c_row,
            alpha: self.alpha,
            onto: self.onto,
        }
    }

    /// # Safety
    /// As [`Product::run`]; `a` and `b` have room for blocks of it.
    unsafe fn part(&self, kernels: &Kernels, part: Part, a: *mut f32, b: *mut f32) {
        let onto = if part.inner > 0 {
            Onto::Product
        } else {
            self.onto
        };
        // SAFETY: all below stays in the product and in the packed blocks, as its caller promises.
        unsafe {
            let panels = self.columns_of(kernels, part, b);
            let stride = self.a.row.max(self.a.column);
            let pack_a = stride.is_multiple_of(SAME_PLACE) && self.columns > panels.width;
            for (first, count) in shares(self.rows, ROWS, 1) {
                let place = self.a.at(first, part.inner);
                if pack_a {
                    for (row, height) in shares(count, kernels.rows, 1) {
                        let to = a.add(row * part.length);
                        pack_rows(kernels, place.at(row, 0), height, part.length, to);
                    }
                }
                for column in (0..part.columns).step_by(panels.width) {
                    let columns = panels.width.min(part.columns - column);
                    let registers = columns.div_ceil(kernels.lanes);
                    let panel = panels.panel(column, columns, part.length);
                    for (index, (row, height)) in shares(count, kernels.rows, 1).enumerate() {
                        let own = place.at(row, 0);
                        let (start, a_row, a_step) = if pack_a {
                            (a.add(row * part.length).cast_const(), 1, height)
                        } else {
                            (own.start, own.row, own.column)
                        };
                        let half = (index % 2) * part.length * 16;
                        let soon = panel.start.wrapping_add(part.length * panel.row + half);
                        let tile = Tile {
                            inner: part.length,
                            a: start,
                            a_row,
                            a_step,
                            b: panel.start,
                            b_step: panel.row,
                            c: self
                                .c
                                .add((first + row) * self.c_row + part.column + column),
                            c_row: self.c_row,
                            columns,
                            alpha: self.alpha,
                            onto: match onto {
                                Onto::Row(values) => Onto::Row(values.add(part.column + column)),
                                onto => onto,
                            },
                            soon: if index < 2 { soon } else { start },
                        };
                        let neighbours = usize::from(a_row == 1);
                        kernels.tiles[height - 1][registers - 1][neighbours](&tile);
                    }
                }
            }
        }
    }

    /// Panels of the columns of `part`, packed into `b` where that pays.
    ///
    /// # Safety
    /// As [`Product::part`].
    unsafe fn columns_of(&self, kernels: &Kernels, part: Part, b: *mut f32) -> Panels {
        let width = 2 * kernels.lanes;
        let place = self.b.at(part.inner, part.column);
        let dense = self.b.column == 1 && self.rows < PACK_B_FROM;
        let whole = part.columns / width * width;
        for column in (0..part.columns).step_by(width) {
            if dense && column < whole {
                continue;
            }
            let columns = width.min(part.columns - column);
            // SAFETY: the panel lies in the product, and in the packed block.
            unsafe {
                let to = b.add(column * part.length);
                pack_columns(kernels, place.at(0, column), columns, part.length, to);
            }
        }
        Panels {
            width,
            lanes: kernels.lanes,
            packed: b,
            dense: dense.then_some(place),
            whole,
        }
    }
}

/// Some columns and inner indices of a product.
#[derive(Debug, Clone, Copy)]
struct Part {
    column: usize,
    columns: usize,
    inner: usize,
    length: usize,
}

/// Where the panels of a block of `b` are.
#[derive(Debug, Clone, Copy)]
struct Panels {
    width: usize,
    lanes: usize,
    packed: *mut f32,
    /// Panels of the full width are read here.
    dense: Option<Operand>,
    /// Columns in panels of the full width.
    whole: usize,
}

impl Panels {
    /// The panel of `columns` columns from `column` on, of `length` inner indices.
    fn panel(&self, column: usize, columns: usize, length: usize) -> Operand {
        match self.dense {
            Some(place) if column < self.whole => place.at(0, column),
            _ => Operand {
                start: self.packed.wrapping_add(column * length),
                row: columns.next_multiple_of(self.lanes),
                column: 1,
            },
        }
    }
}

/// `length` in equal shares of at most `most`, each a multiple of `unit` but the last: start and length of each.
pub(super) fn shares(
    length: usize,
    most: usize,
    unit: usize,
) -> impl Iterator<Item = (usize, usize)> + Clone {
    let count = length.div_ceil(most).max(1);
    let share = length.div_ceil(count).next_multiple_of(unit).max(1);
    (0..length)
        .step_by(share)
        .map(move |start| (start, share.min(length - start)))
}

/// `columns` columns of `b` over `length` inner indices, side by side: each inner index as wide as its registers, zeros behind.
///
/// # Safety
/// The values can be read, and the panel and a register more written.
unsafe fn pack_columns(kernels: &Kernels, b: Operand, columns: usize, length: usize, to: *mut f32) {
    let lanes = kernels.lanes;
    let width = columns.next_multiple_of(lanes);
    // SAFETY: as the caller promises.
    unsafe {
        if b.column == 1 {
            let dense = width == columns;
            for inner in 0..length {
                let (from, to) = (b.start.add(inner * b.row), to.add(inner * width));
                match width {
                    // Known lengths are copied in line.
                    32 if dense => to
                        .cast::<[f32; 32]>()
                        .write(from.cast::<[f32; 32]>().read()),
                    16 if dense => to
                        .cast::<[f32; 16]>()
                        .write(from.cast::<[f32; 16]>().read()),
                    _ => {
                        std::ptr::copy_nonoverlapping(from, to, columns);
                        std::ptr::write_bytes(to.add(columns), 0, width - columns);
                    }
                }
            }
            return;
        }
        for inner in (0..length).step_by(lanes) {
            let indices = lanes.min(length - inner);
            for column in (0..columns).step_by(lanes) {
                let from = b.at(inner, column);
                let count = lanes.min(columns - column);
                let to = to.add(inner * width + column);
                (kernels.transpose)(from.start, from.column, count, indices, to, width);
            }
        }
    }
}

/// `rows` rows of `a` over `length` inner indices, side by side.
///
/// # Safety
/// The values can be read, and the panel and a register more written.
unsafe fn pack_rows(kernels: &Kernels, a: Operand, rows: usize, length: usize, to: *mut f32) {
    let lanes = kernels.lanes;
    // SAFETY: as the caller promises.
    unsafe {
        if a.row == 1 {
            for inner in 0..length {
                let (from, to) = (a.start.add(inner * a.column), to.add(inner * rows));
                std::ptr::copy_nonoverlapping(from, to, rows);
            }
            return;
        }
        // In this order what a block writes too much is written over by the next.
        for inner in (0..length).step_by(lanes) {
            let indices = lanes.min(length - inner);
            let from = a.at(0, inner);
            (kernels.transpose)(
                from.start,
                from.row,
                rows,
                indices,
                to.add(inner * rows),
                rows,
            );
        }
    }
}
