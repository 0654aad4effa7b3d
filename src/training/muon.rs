//! Which parameters Muon moves; the step is [`crate::engine::ops::muon()`].

/// How many matrices of one kind the parameter `name` of this shape holds, stacked over its rows, if Muon is for it: the matrices
/// inside blocks. Tables of embeddings, heads, norms, biases and convolutions are not.
#[must_use]
pub fn matrices(name: &str, shape: &[usize]) -> Option<usize> {
    let in_a_block = name.split('.').any(|part| part.parse::<u32>().is_ok());
    if !in_a_block || shape.len() != 2 || !name.ends_with(".weight") {
        return None;
    }
    let stacked = match name.rsplit('.').nth(1) {
        Some("qkv") => 3,
        Some("kv") => 2,
        _ => 1,
    };
    shape[0].is_multiple_of(stacked).then_some(stacked)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn matrices_of_blocks_alone_are_taken() {
        assert_eq!(matrices("encoder.3.attn.qkv.weight", &[36, 12]), Some(3));
        assert_eq!(matrices("decoder.0.cross.kv.weight", &[24, 12]), Some(2));
        assert_eq!(matrices("encoder.0.mlp.fc1.weight", &[32, 12]), Some(1));
        assert_eq!(matrices("encoder.0.norm1.weight", &[12]), None);
        assert_eq!(
            matrices("encoder_embeddings.rgb.token_emb.weight", &[9, 4]),
            None
        );
        assert_eq!(matrices("down.0.conv.weight", &[4, 4, 3, 3, 3]), None);
    }
}
