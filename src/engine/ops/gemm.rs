//! Matrix products on slices: the seam to the `gemm` crate.
#![allow(unsafe_code)]

use gemm::Parallelism;

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

    pub fn transposed(self) -> Self {
        Self {
            values: self.values,
            rows: self.columns,
            columns: self.rows,
            row_stride: self.column_stride,
            column_stride: self.row_stride,
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
        let (m, n, k) = (a.rows, b.columns, a.columns);
        assert_eq!(b.rows, k, "inner sizes");
        assert!(
            a.extent() <= a.values.len() && b.extent() <= b.values.len(),
            "operands lie in their slices"
        );
        if m == 0 || n == 0 {
            return;
        }
        assert!(
            n <= row_stride && start + (m - 1) * row_stride + n <= self.length,
            "the product lies in its slice"
        );
        // SAFETY: the assertions bound every element that is read and written; `c` is nobody else's by the caller's promise,
        // so it does not overlap `a` or `b`; f32 is what `gemm` dispatches on.
        unsafe {
            gemm::gemm(
                m,
                n,
                k,
                self.start.add(start),
                1,
                row_stride as isize,
                add,
                a.values.as_ptr(),
                a.column_stride as isize,
                a.row_stride as isize,
                b.values.as_ptr(),
                b.column_stride as isize,
                b.row_stride as isize,
                if add { 1.0 } else { 0.0 },
                alpha,
                false,
                false,
                false,
                match threads {
                    Threads::One => Parallelism::None,
                    Threads::All => Parallelism::Rayon(0),
                },
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
        ] {
            let a: Vec<f32> = (0..m * k).map(|i| (i as f32 * 0.37).sin()).collect();
            let b: Vec<f32> = (0..k * n).map(|i| (i as f32 * 0.11).cos()).collect();
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
