//! Matrix products on slices, with kernels for the instructions of the processor.
//!
//! Read in this order: this file (matrices, and how a product is shared between threads), [`blocked`] (one thread: blocks and
//! packing), [`tile`] (the innermost loop) and what it is made of on [`avx512`], [`avx2`] and [`portable`].
//!
//! **Same bits.** Each element is a chain of fused multiply-adds over the inner index, in blocks whose length depends on the inner
//! length alone; where `a` has a single row and the columns of `b` lie in one piece, sixteen such chains are added in a fixed order. So
//! results are the same on any number of threads and on any processor with fused multiply-adds: x86 since 2013 (AVX2 or AVX-512) and
//! 64-bit ARM. Elsewhere products and sums are rounded one after the other.
#![allow(unsafe_code)]

#[cfg(target_arch = "x86_64")]
mod avx2;
#[cfg(target_arch = "x86_64")]
mod avx512;
mod blocked;
mod portable;
mod tile;

use std::sync::OnceLock;

use rayon::prelude::*;

use blocked::Product;
use tile::{Onto, StripFunction, TileFunctions};

/// Whether the portable tiles fuse multiplication and addition: the target always has the instruction.
const PORTABLE_FUSES: bool = cfg!(any(target_arch = "aarch64", target_feature = "fma"));

/// What is done per thread, at least: about the time a task takes to reach another thread.
const WORK: usize = 256 * 1024;
/// Tasks per thread, so that one that is held up does not hold up all.
const TASKS: usize = 4;

/// The innermost loops, and how to arrange their operands, on one instruction set.
struct Kernels {
    /// Of a tile, at most.
    rows: usize,
    /// Values of a register; a tile is at most two registers wide.
    lanes: usize,
    /// By rows, from one on.
    tiles: &'static [TileFunctions],
    /// A single row by columns whose inner indices are neighbours.
    row: StripFunction,
    /// A single inner index.
    outer: StripFunction,
    transpose: unsafe fn(*const f32, usize, usize, usize, *mut f32, usize),
}

/// The fastest this processor has.
fn kernels() -> &'static Kernels {
    static FOUND: OnceLock<&'static Kernels> = OnceLock::new();
    FOUND.get_or_init(|| {
        let all = available();
        all[0]
    })
}

/// All that this processor has, fastest first.
fn available() -> Vec<&'static Kernels> {
    let mut all = Vec::new();
    #[cfg(target_arch = "x86_64")]
    {
        if is_x86_feature_detected!("avx512f") {
            all.push(&avx512::KERNELS);
        }
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            all.push(&avx2::KERNELS);
        }
    }
    all.push(&portable::KERNELS);
    all
}

/// Where a matrix lies: rows or columns are neighbours.
#[derive(Debug, Clone, Copy)]
struct Operand {
    start: *const f32,
    /// From one row to the next.
    row: usize,
    /// From one column to the next.
    column: usize,
}

impl Operand {
    /// From `row` and `column` on.
    fn at(self, row: usize, column: usize) -> Self {
        Self {
            start: self
                .start
                .wrapping_add(row * self.row + column * self.column),
            ..self
        }
    }
}

// SAFETY: an operand is only a place; whoever reads through it promises that it can be read.
unsafe impl Send for Operand {}
// SAFETY: as above.
unsafe impl Sync for Operand {}

/// How many threads take part in one product. The result is the same for any number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Threads {
    /// The caller is one of many tasks.
    One,
    /// All of the thread pool.
    All,
}

/// A matrix in a slice, with any strides.
#[derive(Debug, Clone, Copy)]
pub struct Matrix<'a> {
    values: &'a [f32],
    rows: usize,
    columns: usize,
    row_stride: usize,
    column_stride: usize,
}

impl<'a> Matrix<'a> {
    /// Row-major `rows x columns`.
    pub fn rows(values: &'a [f32], rows: usize, columns: usize) -> Self {
        Self::strided(values, rows, columns, columns)
    }

    /// Row-major with `row_stride` values from one row to the next.
    pub fn strided(values: &'a [f32], rows: usize, columns: usize, row_stride: usize) -> Self {
        Self {
            values,
            rows,
            columns,
            row_stride,
            column_stride: 1,
        }
    }

    pub fn columns(&self) -> usize {
        self.columns
    }

    #[must_use]
    pub fn transposed(self) -> Self {
        Self {
            values: self.values,
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
        }
    }

    fn operand(&self) -> Operand {
        Operand {
            start: self.values.as_ptr(),
            row: self.row_stride,
            column: self.column_stride,
        }
    }

    /// One past the last element that is read.
    fn extent(&self) -> usize {
        if self.rows == 0 || self.columns == 0 {
            return 0;
        }
        (self.rows - 1) * self.row_stride + (self.columns - 1) * self.column_stride + 1
    }
}

/// `a b`, onto `bias` in each row if there is one: row-major and dense.
///
/// # Panics
/// When the matrices do not fit each other, their slices or the bias.
#[must_use]
pub fn product(a: Matrix<'_>, b: Matrix<'_>, bias: Option<&[f32]>, threads: Threads) -> Vec<f32> {
    let length = a.rows * b.columns;
    let mut c: Vec<f32> = Vec::with_capacity(length);
    let onto = match bias {
        Some(bias) => {
            assert_eq!(bias.len(), b.columns, "one value of the bias per column");
            Onto::Row(bias.as_ptr())
        }
        None => Onto::Nothing,
    };
    let place = Shared {
        start: c.as_mut_ptr(),
        length,
        borrow: std::marker::PhantomData,
    };
    // SAFETY: `c` is ours and has the room; nothing of it is read, and every element is written before its length says so.
    unsafe {
        place.run(kernels(), 0, b.columns, a, b, 1.0, onto, threads);
        c.set_len(length);
    }
    c
}

/// `c = a b`; `c` is row-major and dense.
pub fn gemm(c: &mut [f32], a: Matrix<'_>, b: Matrix<'_>) {
    gemm_into(c, b.columns, a, b, 1.0, false, Threads::One);
}

/// `c = alpha a b`, or `c += alpha a b` if `add`; `c` is row-major with `row_stride` values from one row to the next.
///
/// # Panics
/// When the matrices do not fit each other or their slices.
pub fn gemm_into(
    c: &mut [f32],
    row_stride: usize,
    a: Matrix<'_>,
    b: Matrix<'_>,
    alpha: f32,
    add: bool,
    threads: Threads,
) {
    // SAFETY: `c` is borrowed uniquely for the whole call.
    unsafe { Shared::new(c).gemm(0, row_stride, a, b, alpha, add, threads) }
}

/// A slice that several tasks write at once, each at places of its own.
#[derive(Debug, Clone, Copy)]
pub struct Shared<'a> {
    start: *mut f32,
    length: usize,
    borrow: std::marker::PhantomData<&'a mut [f32]>,
}

// SAFETY: a `Shared` is only a place; every write through it is `unsafe` and promises not to overlap any other.
unsafe impl Send for Shared<'_> {}
// SAFETY: as above.
unsafe impl Sync for Shared<'_> {}

impl<'a> Shared<'a> {
    pub fn new(values: &'a mut [f32]) -> Self {
        Self {
            start: values.as_mut_ptr(),
            length: values.len(),
            borrow: std::marker::PhantomData,
        }
    }

    /// The elements `start..start + length`.
    ///
    /// # Safety
    /// Nobody else touches them while the slice lives.
    pub unsafe fn part(self, start: usize, length: usize) -> &'a mut [f32] {
        assert!(start + length <= self.length, "the part lies in the slice");
        // SAFETY: in bounds by the assertion, unique by the caller's promise.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(start), length) }
    }

    /// `c = alpha a b`, or `c += alpha a b` if `add`, where `c` is row-major from element `start` with `row_stride` values from
    /// one row to the next.
    ///
    /// # Safety
    /// Nobody else touches the elements of `c` meanwhile.
    #[allow(clippy::similar_names)]
    pub unsafe fn gemm(
        self,
        start: usize,
        row_stride: usize,
        a: Matrix<'_>,
        b: Matrix<'_>,
        alpha: f32,
        add: bool,
        threads: Threads,
    ) {
        let onto = if add { Onto::Product } else { Onto::Nothing };
        // SAFETY: `c` is nobody else's by the caller's promise, so it does not overlap `a` or `b`; the kernels are those of this
        // processor.
        unsafe { self.run(kernels(), start, row_stride, a, b, alpha, onto, threads) }
    }

    /// # Safety
    /// The processor has the instructions of `kernels`; nobody else touches the product; a row in `onto` has a value per column.
    unsafe fn run(
        self,
        kernels: &'static Kernels,
        start: usize,
        row_stride: usize,
        a: Matrix<'_>,
        b: Matrix<'_>,
        alpha: f32,
        onto: Onto,
        threads: Threads,
    ) {
        let (rows, columns, inner) = (a.rows, b.columns, a.columns);
        assert_eq!(b.rows, inner, "inner sizes");
        assert!(
            a.extent() <= a.values.len() && b.extent() <= b.values.len(),
            "operands lie in their slices"
        );
        if rows == 0 || columns == 0 {
            return;
        }
        assert!(
            columns <= row_stride && start + (rows - 1) * row_stride + columns <= self.length,
            "the product lies in its slice"
        );
        let (a, b) = (a.operand(), b.operand());
        let onto = SharedOnto(onto);
        // Of the whole product: the share of a task must not choose other sums.
        let single_row = rows == 1 && a.column == 1 && b.row == 1 && b.column >= inner;
        let task = move |(row, rows): (usize, usize), (column, columns): (usize, usize)| {
            // Captured whole: the pointers in them may cross threads only as these.
            let (this, onto) = (self, onto);
            let product = Product {
                rows,
                columns,
                inner,
                a: a.at(row, 0),
                b: b.at(0, column),
                c: this.start.wrapping_add(start + row * row_stride + column),
                c_row: row_stride,
                alpha,
                single_row,
                onto: match onto.0 {
                    Onto::Row(values) => Onto::Row(values.wrapping_add(column)),
                    onto => onto,
                },
            };
            // SAFETY: the assertions above bound every element that is read and written; the task's rows and columns of the product
            // are its own; all else by the caller's promise.
            unsafe { product.run(kernels) }
        };
        let tasks = match threads {
            Threads::One => 1,
            Threads::All => tasks(rows, columns, inner, rayon::current_num_threads()),
        };
        if tasks == 1 {
            task((0, rows), (0, columns));
            return;
        }
        let (down, across) = grid(rows, columns, tasks);
        let rows: Vec<_> = blocked::shares(rows, rows.div_ceil(down), kernels.rows).collect();
        let width = 2 * kernels.lanes;
        let columns: Vec<_> = blocked::shares(columns, columns.div_ceil(across), width).collect();
        (0..rows.len() * columns.len())
            .into_par_iter()
            .with_max_len(1)
            .for_each(|index| task(rows[index / columns.len()], columns[index % columns.len()]));
    }
}

/// [`Onto`] for tasks on other threads.
#[derive(Debug, Clone, Copy)]
struct SharedOnto(Onto);

// SAFETY: what its pointer leads to is borrowed for the whole product, and only read.
unsafe impl Send for SharedOnto {}
// SAFETY: as above.
unsafe impl Sync for SharedOnto {}

/// Into how many tasks a product is cut.
fn tasks(rows: usize, columns: usize, inner: usize, threads: usize) -> usize {
    if threads == 1 {
        return 1;
    }
    let work = rows * columns * inner.max(1);
    (work / WORK).clamp(1, threads * TASKS)
}

/// Rows and columns of a grid of at least `tasks` tasks that packs the least: each row of tasks packs all of `b`, each column all
/// of `a`.
fn grid(rows: usize, columns: usize, tasks: usize) -> (usize, usize) {
    (1..=tasks)
        .map(|down| (down, tasks.div_ceil(down)))
        .min_by_key(|(down, across)| down * columns + across * rows)
        .unwrap_or((1, 1))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn waves(length: usize, pace: f32) -> Vec<f32> {
        (0..length).map(|i| (i as f32 * pace).sin()).collect()
    }

    /// Shapes around the borders of tiles, panels and blocks.
    const SHAPES: [[usize; 3]; 15] = [
        [1, 1, 1],
        [1, 37, 5],
        [1, 400, 70],
        [5, 1, 40],
        [3, 0, 5],
        [7, 500, 64],
        [14, 16, 32],
        [15, 17, 33],
        [43, 1, 31],
        [64, 64, 1],
        [50, 513, 47],
        [300, 24, 16],
        [31, 1024, 70],
        [129, 40, 1030],
        [141, 1100, 95],
    ];

    /// Both operands as they lie, or transposed in memory, with room between rows.
    fn operands(
        [m, k, n]: [usize; 3],
        [turn_a, turn_b]: [bool; 2],
        run: impl FnOnce(Matrix<'_>, Matrix<'_>),
    ) {
        let lie = |rows: usize, columns: usize, turned: bool, pace: f32| {
            let (rows, columns) = if turned {
                (columns, rows)
            } else {
                (rows, columns)
            };
            (waves(rows * (columns + 3), pace), rows, columns)
        };
        let (a, a_rows, a_columns) = lie(m, k, turn_a, 0.37);
        let (b, b_rows, b_columns) = lie(k, n, turn_b, 0.11);
        let matrix = |values, rows, columns, turned| {
            let matrix = Matrix::strided(values, rows, columns, columns + 3);
            if turned { matrix.transposed() } else { matrix }
        };
        run(
            matrix(&a, a_rows, a_columns, turn_a),
            matrix(&b, b_rows, b_columns, turn_b),
        );
    }

    const TURNS: [[bool; 2]; 4] = [[false, false], [false, true], [true, false], [true, true]];

    fn at(matrix: Matrix<'_>, row: usize, column: usize) -> f64 {
        f64::from(matrix.values[row * matrix.row_stride + column * matrix.column_stride])
    }

    fn on(
        kernels: &'static Kernels,
        a: Matrix<'_>,
        b: Matrix<'_>,
        alpha: f32,
        add: bool,
    ) -> Vec<f32> {
        let row = b.columns + 2;
        let mut c = vec![0.5; a.rows * row];
        let onto = if add { Onto::Product } else { Onto::Nothing };
        // SAFETY: the kernels are of those that this processor has; `c` is borrowed uniquely.
        unsafe { Shared::new(&mut c).run(kernels, 0, row, a, b, alpha, onto, Threads::One) };
        c
    }

    #[test]
    fn every_kernel_computes_the_product_and_writes_nothing_beside_it() {
        for kernels in available() {
            for (shape, turns) in SHAPES.into_iter().flat_map(|s| TURNS.map(|t| (s, t))) {
                for (alpha, add) in [(1.0, false), (0.5, true)] {
                    operands(shape, turns, |a, b| {
                        let c = on(kernels, a, b, alpha, add);
                        for (row, values) in c.chunks_exact(b.columns + 2).enumerate() {
                            for (column, value) in values[..b.columns].iter().enumerate() {
                                let sum: f64 =
                                    (0..b.rows).map(|i| at(a, row, i) * at(b, i, column)).sum();
                                let sum = sum * f64::from(alpha) + if add { 0.5 } else { 0.0 };
                                let error = (f64::from(*value) - sum).abs();
                                assert!(error < 2e-4, "{shape:?} {turns:?}: {value}, not {sum}");
                            }
                            assert_eq!(values[b.columns..], [0.5; 2], "{shape:?} {turns:?}");
                        }
                    });
                }
            }
        }
    }

    #[test]
    fn a_product_has_the_same_bits_on_every_processor_that_fuses() {
        let mut all = available();
        if !PORTABLE_FUSES {
            all.pop();
        }
        for (shape, turns) in SHAPES.into_iter().flat_map(|s| TURNS.map(|t| (s, t))) {
            operands(shape, turns, |a, b| {
                for pair in all.windows(2) {
                    let [c, d] = [pair[0], pair[1]].map(|kernels| on(kernels, a, b, 0.5, true));
                    assert_eq!(c, d, "{shape:?} {turns:?}");
                }
            });
        }
    }

    #[test]
    fn a_bias_is_what_the_product_is_put_onto() {
        for [m, k, n] in SHAPES {
            let (a, b, bias) = (waves(m * k, 0.3), waves(k * n, 0.2), waves(n, 1.0));
            let (a, b) = (Matrix::rows(&a, m, k), Matrix::rows(&b, k, n));
            let plain = product(a, b, None, Threads::One);
            let raised = product(a, b, Some(&bias), Threads::All);
            for (place, (raised, plain)) in raised.iter().zip(&plain).enumerate() {
                assert!((raised - plain - bias[place % n]).abs() < 1e-4);
            }
        }
    }

    /// What the determinism of everything above rests on.
    #[test]
    fn a_product_has_the_same_bits_on_any_number_of_threads() {
        for (m, k, n) in [
            (1680, 96, 288),
            (7, 500, 64),
            (300, 1, 300),
            (64, 64, 1),
            (257, 129, 65),
            (64, 1000, 1030),
            // Of one row, and with a share of one row.
            (1, 3000, 700),
            (43, 2000, 64),
        ] {
            let (a, b) = (waves(m * k, 0.37), waves(k * n, 0.11));
            let product = |threads: usize, transposed: bool| {
                let pool = rayon::ThreadPoolBuilder::new()
                    .num_threads(threads)
                    .build()
                    .unwrap();
                let mut c = vec![0.5; m * n];
                let b = if transposed {
                    Matrix::rows(&b, n, k).transposed()
                } else {
                    Matrix::rows(&b, k, n)
                };
                let a = Matrix::rows(&a, m, k);
                pool.install(|| gemm_into(&mut c, n, a, b, 0.5, true, Threads::All));
                c
            };
            for transposed in [false, true] {
                let one = product(1, transposed);
                for threads in [2, 3, 5] {
                    assert_eq!(
                        product(threads, transposed),
                        one,
                        "{m}x{k}x{n} on {threads}"
                    );
                }
            }
        }
    }
}
