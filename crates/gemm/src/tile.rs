//! One tile of a product: a few rows by a few registers, all sums in registers over the whole inner length.
//!
//! Each sum is one chain of fused multiply-adds in the order of the inner index. So a tile's shape, and with it the processor's
//! instruction set, does not change a bit of the result. A product of a single row is not worth a tile: see [`Strip`].

/// What a tile's sums are put onto.
#[derive(Debug, Clone, Copy)]
pub(super) enum Onto {
    Nothing,
    /// What is in `c`.
    Product,
    /// A row of values, one a column.
    Row(*const f32),
}

/// One tile: `c = alpha a b` onto something.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tile {
    /// Inner length.
    pub inner: usize,
    pub a: *const f32,
    /// From one row of `a` to the next, where that is not 1.
    pub a_row: usize,
    /// From one inner index of `a` to the next.
    pub a_step: usize,
    pub b: *const f32,
    /// From one inner index of `b` to the next.
    pub b_step: usize,
    pub c: *mut f32,
    pub c_row: usize,
    /// Columns of `c` that are written.
    pub columns: usize,
    pub alpha: f32,
    pub onto: Onto,
    /// What will be needed soon: brought into the second-level cache, 16 values for each inner index.
    pub soon: *const f32,
}

/// Computes a tile of a fixed number of rows and registers.
///
/// # Safety
/// The processor has the instructions. `a` and `b` can be read at every row (column) and inner index, `b` as wide as its registers;
/// `columns` columns of `c` can be written, and nobody else touches them; [`Onto::Row`] has as many values.
pub(super) type TileFunction = unsafe fn(&Tile);

/// A product of a single row, or of a single inner index, that goes without tiles.
#[derive(Debug, Clone, Copy)]
pub(super) struct Strip {
    pub rows: usize,
    pub columns: usize,
    pub inner: usize,
    pub a: *const f32,
    /// From one row of `a` to the next.
    pub a_row: usize,
    pub b: *const f32,
    /// From one column of `b` to the next.
    pub b_column: usize,
    pub c: *mut f32,
    pub c_row: usize,
    pub alpha: f32,
    pub onto: Onto,
}

/// Computes a [`Strip`].
///
/// # Safety
/// The processor has the instructions. `a` and `b` can be read at every row (column) and inner index; `c` can be written, and nobody
/// else touches it; [`Onto::Row`] has as many values.
pub(super) type StripFunction = unsafe fn(&Strip);

/// Sums of a row's element: every inner index of the same remainder goes into the same sum, on every processor.
pub(super) const SUMS: usize = 16;

/// Of the [`SUMS`] of an element, in one order on every processor.
#[inline]
pub(super) fn total(sums: [f32; SUMS]) -> f32 {
    let eight: [f32; 8] = std::array::from_fn(|i| sums[i] + sums[i + 8]);
    let four: [f32; 4] = std::array::from_fn(|i| eight[i] + eight[i + 4]);
    (four[0] + four[2]) + (four[1] + four[3])
}

/// Tiles of so many rows: `[registers - 1][rows of `a` are neighbours]`.
pub(super) type TileFunctions = [[TileFunction; 2]; 2];

/// The [`TileFunctions`] of `$rows` rows.
macro_rules! tile_functions {
    ($tile:ident, $rows:literal) => {
        [
            [$tile::<$rows, 1, false>, $tile::<$rows, 1, true>],
            [$tile::<$rows, 2, false>, $tile::<$rows, 2, true>],
        ]
    };
}

/// Defines `tile<ROWS, REGISTERS, NEIGHBOURS>`, and `row` and `outer` for strips, with the vector operations of the module it is called
/// in, compiled for `$feature`.
macro_rules! tile {
    ($($feature:literal)?) => {
        /// # Safety
        /// See [`super::tile::TileFunction`].
        $(#[target_feature(enable = $feature)])?
        unsafe fn tile<const ROWS: usize, const REGISTERS: usize, const NEIGHBOURS: bool>(tile: &Tile) {
            let mut sums = [[zero(); REGISTERS]; ROWS];
            for row in 0..ROWS {
                for register in 0..REGISTERS {
                    prefetch_near(tile.c.wrapping_add(row * tile.c_row + register * LANES));
                }
            }
            let (mut a, mut b, mut soon) = (tile.a, tile.b, tile.soon);
            for _ in 0..tile.inner {
                prefetch_far(soon);
                soon = soon.wrapping_add(16);
                if NEIGHBOURS {
                    prefetch_near(a.wrapping_add(16 * tile.a_step));
                }
                let mut columns = [zero(); REGISTERS];
                for (register, columns) in columns.iter_mut().enumerate() {
                    // SAFETY: `b` is as wide as its registers at every inner index.
                    *columns = unsafe { load(b.add(register * LANES)) };
                }
                for (row, sums) in sums.iter_mut().enumerate() {
                    let place = if NEIGHBOURS { row } else { row * tile.a_row };
                    // SAFETY: `a` is there at every row and inner index.
                    let value = splat(unsafe { *a.add(place) });
                    for (sum, columns) in sums.iter_mut().zip(columns) {
                        *sum = multiply_add(value, columns, *sum);
                    }
                }
                a = a.wrapping_add(tile.a_step);
                b = b.wrapping_add(tile.b_step);
            }
            let alpha = splat(tile.alpha);
            for (row, sums) in sums.into_iter().enumerate() {
                for (register, sum) in sums.into_iter().enumerate() {
                    let place = register * LANES;
                    if place >= tile.columns {
                        continue;
                    }
                    let count = tile.columns - place;
                    let mut value = multiply(sum, alpha);
                    // SAFETY: `count` columns of `c` from here on are ours, and a row has as many values.
                    unsafe {
                        let c = tile.c.add(row * tile.c_row + place);
                        match tile.onto {
                            Onto::Nothing => {}
                            Onto::Product => value = plus(value, load_part(c, count)),
                            Onto::Row(values) => value = plus(value, load_part(values.add(place), count)),
                        }
                        store_part(c, count, value);
                    }
                }
            }
        }

        /// One row of `a` by columns of `b` whose inner indices are neighbours.
        ///
        /// # Safety
        /// See [`super::tile::StripFunction`].
        $(#[target_feature(enable = $feature)])?
        unsafe fn row(strip: &Strip) {
            const TOGETHER: usize = 4;
            let together = strip.columns - strip.columns % TOGETHER;
            for column in (0..together).step_by(TOGETHER) {
                // SAFETY: so many columns are there, by the caller's promise.
                unsafe { dots::<TOGETHER>(strip, column) };
            }
            for column in together..strip.columns {
                // SAFETY: as above.
                unsafe { dots::<1>(strip, column) };
            }
        }

        /// # Safety
        /// See [`super::tile::StripFunction`]; `COLUMNS` columns are there from `column` on.
        $(#[target_feature(enable = $feature)])?
        unsafe fn dots<const COLUMNS: usize>(strip: &Strip, column: usize) {
            const PARTS: usize = SUMS / LANES;
            let mut sums = [[zero(); PARTS]; COLUMNS];
            let whole = strip.inner - strip.inner % SUMS;
            let b = strip.b.wrapping_add(column * strip.b_column);
            // SAFETY: all that is read lies in the row, and in the columns.
            unsafe {
                for inner in (0..whole).step_by(SUMS) {
                    for part in 0..PARTS {
                        let place = inner + part * LANES;
                        let value = load(strip.a.add(place));
                        for (index, sums) in sums.iter_mut().enumerate() {
                            let own = load(b.add(index * strip.b_column + place));
                            sums[part] = multiply_add(value, own, sums[part]);
                        }
                    }
                }
                for part in 0..PARTS {
                    let place = whole + part * LANES;
                    if place >= strip.inner {
                        break;
                    }
                    let count = strip.inner - place;
                    let value = load_part(strip.a.add(place), count);
                    for (index, sums) in sums.iter_mut().enumerate() {
                        let own = load_part(b.add(index * strip.b_column + place), count);
                        sums[part] = multiply_add(value, own, sums[part]);
                    }
                }
                for (index, sums) in sums.into_iter().enumerate() {
                    let mut values = [0.0; SUMS];
                    for (part, sum) in sums.into_iter().enumerate() {
                        store(values.as_mut_ptr().add(part * LANES), sum);
                    }
                    let value = super::tile::total(values) * strip.alpha;
                    let c = strip.c.add(column + index);
                    c.write(match strip.onto {
                        Onto::Nothing => value,
                        Onto::Product => value + c.read(),
                        Onto::Row(values) => value + values.add(column + index).read(),
                    });
                }
            }
        }

        /// A column of `a` by a row of `b`: the bits are those of tiles.
        ///
        /// # Safety
        /// See [`super::tile::StripFunction`].
        $(#[target_feature(enable = $feature)])?
        unsafe fn outer(strip: &Strip) {
            let alpha = splat(strip.alpha);
            for row in 0..strip.rows {
                // SAFETY: all that is read and written lies in the operands and in the product.
                unsafe {
                    let value = splat(*strip.a.add(row * strip.a_row));
                    let c = strip.c.add(row * strip.c_row);
                    for column in (0..strip.columns).step_by(LANES) {
                        let count = strip.columns - column;
                        let b = load_part(strip.b.add(column), count);
                        let value = multiply(multiply_add(value, b, zero()), alpha);
                        let value = match strip.onto {
                            Onto::Nothing => value,
                            Onto::Product => plus(value, load_part(c.add(column), count)),
                            Onto::Row(values) => plus(value, load_part(values.add(column), count)),
                        };
                        store_part(c.add(column), count, value);
                    }
                }
            }
        }
    };
}

pub(super) use {tile, tile_functions};
