//! The values: bytes of either order to elements, and Fortran order to C order.

use super::header::Header;
use super::{Dtype, FormatError, NpyData, malformed};
use half::f16;

/// The elements in file order. `body` has been checked to be a whole number of elements.
pub(super) fn decode(body: &[u8], header: &Header) -> Result<NpyData, FormatError> {
    macro_rules! numbers {
        ($variant:ident, $t:ty) => {
            NpyData::$variant(
                body.chunks_exact(size_of::<$t>())
                    .map(|chunk| {
                        let mut bytes = [0; size_of::<$t>()];
                        bytes.copy_from_slice(chunk);
                        if header.big_endian {
                            <$t>::from_be_bytes(bytes)
                        } else {
                            <$t>::from_le_bytes(bytes)
                        }
                    })
                    .collect(),
            )
        };
    }
    Ok(match header.dtype {
        Dtype::Bool => {
            if let Some(at) = body.iter().position(|&b| b > 1) {
                let reason = format!("a truth value of {}", body[at]);
                return Err(malformed((header.end + at) as u64, reason));
            }
            NpyData::Bool(body.iter().map(|&b| b == 1).collect())
        }
        Dtype::U8 => NpyData::U8(body.to_vec()),
        Dtype::I8 => numbers!(I8, i8),
        Dtype::I16 => numbers!(I16, i16),
        Dtype::I32 => numbers!(I32, i32),
        Dtype::I64 => numbers!(I64, i64),
        Dtype::U16 => numbers!(U16, u16),
        Dtype::U32 => numbers!(U32, u32),
        Dtype::U64 => numbers!(U64, u64),
        Dtype::F16 => numbers!(F16, f16),
        Dtype::F32 => numbers!(F32, f32),
        Dtype::F64 => numbers!(F64, f64),
    })
}

/// For every element in C order, where it lies in Fortran order.
pub(super) fn c_order(shape: &[usize]) -> impl Iterator<Item = usize> {
    let mut strides = Vec::with_capacity(shape.len());
    let mut stride = 1;
    for &d in shape {
        strides.push(stride);
        stride *= d.max(1);
    }
    let shape = shape.to_vec();
    let count = shape.iter().product();
    (0..count).map(move |mut i| {
        let mut at = 0;
        for (d, s) in shape.iter().zip(&strides).rev() {
            at += i % d * s;
            i /= d;
        }
        at
    })
}
