//! Tables of the host on the device.

use burn::tensor::DType;
use burn_cubecl::tensor::CubeTensor;
use cubecl::prelude::CubeElement;

/// Whole numbers on the device of `like`. Never without an element: no device has such an array.
pub fn upload(values: &[u32], like: &CubeTensor) -> CubeTensor {
    let values = if values.is_empty() { &[0] } else { values };
    let handle = like.client.create_from_slice(u32::as_bytes(values));
    CubeTensor::new_contiguous(
        like.client.clone(),
        like.device.clone(),
        [values.len()].into(),
        handle,
        DType::U32,
    )
}

/// Lists of whole numbers, one after the other: `starts[i]..starts[i + 1]` is where list `i` stands, `starts` first.
pub fn lists(lists: &[Vec<u32>]) -> Vec<u32> {
    let mut table = Vec::with_capacity(lists.len() + 1);
    let mut next = lists.len() as u32 + 1;
    table.push(next);
    for list in lists {
        next += list.len() as u32;
        table.push(next);
    }
    table.extend(lists.iter().flatten());
    table
}
