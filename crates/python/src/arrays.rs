//! Arrays to NumPy: moved, or seen in place.

use crate::error::refused;
use ndarray::{ArrayD, ArrayView, Dimension, IxDyn};
use numpy::{Element, IntoPyArray, PyArray, PyArrayMethods};
use pyo3::prelude::*;
use reviv::formats::npy::{NpyArray, NpyData};

/// A read-only NumPy array over memory that `owner` holds and never changes; the array keeps `owner` alive.
pub fn view<'py, T: Element, D: Dimension>(
    values: ArrayView<'_, T, D>,
    owner: &Bound<'py, PyAny>,
) -> PyResult<Bound<'py, PyAny>> {
    // SAFETY: `values` lies in the frozen object `owner`, which the array holds a reference to, so that the memory neither moves nor
    // changes while the array lives. Nobody writes through the array either: it is made read-only before it is handed out.
    #[allow(unsafe_code)]
    let array = unsafe { PyArray::borrow_from_array(&values, owner.clone()) };
    let array = array.try_readwrite()?.make_nonwriteable();
    Ok(array.as_any().clone())
}

/// Moves an array to NumPy, whatever its numbers are; half floats become floats.
pub fn moved(py: Python<'_>, array: NpyArray) -> PyResult<Bound<'_, PyAny>> {
    let shape = IxDyn(&array.shape);
    macro_rules! by_kind {
        ($($kind:ident),*) => {
            match array.data {
                $(NpyData::$kind(values) => owned(py, shape, values),)*
                NpyData::F16(values) => {
                    owned(py, shape, values.into_iter().map(f32::from).collect())
                }
            }
        };
    }
    by_kind!(Bool, I8, I16, I32, I64, U8, U16, U32, U64, F32, F64)
}

/// Moves these values to NumPy.
pub fn owned<T: Element>(
    py: Python<'_>,
    shape: IxDyn,
    values: Vec<T>,
) -> PyResult<Bound<'_, PyAny>> {
    let array = ArrayD::from_shape_vec(shape, values).map_err(|error| refused(py, error, ""))?;
    Ok(array.into_pyarray(py).into_any())
}
