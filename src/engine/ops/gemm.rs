//! Single-threaded matrix products on slices: the seam to the `gemm` crate. Parallelism is the caller's, over fixed blocks.
#![allow(unsafe_code)]

use gemm::Parallelism;

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
    gemm_into(c, b.columns, a, b, 1.0, false);
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
        (m - 1) * row_stride + n <= c.len(),
        "the product lies in its slice"
    );
    // SAFETY: the assertions above bound every element that the product reads and writes; `c` is borrowed uniquely and cannot
    // overlap `a` or `b`; f32 is what `gemm` dispatches on.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            c.as_mut_ptr(),
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
            Parallelism::None,
        );
    }
}
