//! The transformer that fuses an image map and a LiDAR map at one scale.

use super::builder::Builder;
use super::detect::{common_length, indexed_count, most_common};
use crate::error::Result;
use crate::import::NamedTensors;
use crate::ir::{Clip, LayerNorm, Op, Tokens, ValueId, Weights};
use std::sync::Arc;

/// As published.
const DEFAULT_HEADS: u16 = 4;

pub(super) struct Transformer {
    scale: usize,
    channels: usize,
    hidden: usize,
    layers: usize,
    grid: (u16, u16),
    position: bool,
}

fn prefix(scale: usize) -> String {
    format!("encoder.transformer{scale}")
}

/// Positional embeddings that are there.
fn positions(tensors: &NamedTensors) -> impl Iterator<Item = &[usize]> {
    (1..=4).filter_map(|scale| Some(&tensors.get(&format!("{}.pos_emb", prefix(scale)))?.shape[..]))
}

impl Transformer {
    /// Tokens that the positional embeddings are made for, both maps together.
    pub(super) fn tokens(tensors: &NamedTensors) -> Option<usize> {
        most_common(positions(tensors).filter_map(|shape| shape.get(1).copied()))
    }

    /// The transformer of each scale that has one. Embeddings belong to all scales or to none (the ablation without
    /// them; where it kept its unused zeros in the checkpoint, adding them changes nothing).
    pub(super) fn detect_all(tensors: &NamedTensors, widths: &[usize; 4], grid: (u16, u16)) -> [Option<Self>; 4] {
        let position = positions(tensors).next().is_some();
        std::array::from_fn(|s| {
            let p = format!("{}.", prefix(s + 1));
            tensors.under(&p).next()?;
            let blocks = format!("{p}blocks.");
            Some(Self {
                scale: s + 1,
                channels: widths[s],
                hidden: common_length(tensors, &[&blocks], |n| n.contains(".mlp.0.")).unwrap_or(4 * widths[s]),
                layers: indexed_count(tensors, &blocks).max(1),
                grid,
                position,
            })
        })
    }

    /// Adds the fused features to both maps.
    pub(super) fn fuse(
        &self,
        b: &mut Builder<'_>,
        image: ValueId,
        lidar: ValueId,
        velocity: ValueId,
    ) -> Result<(ValueId, ValueId)> {
        let p = prefix(self.scale);
        let tokens = Op::Tokens(self.embedding(b));
        let mut stream = b.push(format!("{p}.tokens"), tokens, &[image, lidar, velocity])?;
        for layer in 0..self.layers {
            stream = self.block(b, &format!("{p}.blocks.{layer}"), stream)?;
        }
        let norm = b.layer_norm(&format!("{p}.ln_f"), self.channels, self.grid);
        let lidar_norm = LayerNorm { first_row: self.grid.0 * self.grid.1, ..norm.clone() };
        let image = self.add_back(b, "image", norm, stream, image)?;
        let lidar = self.add_back(b, "lidar", lidar_norm, stream, lidar)?;
        Ok((image, lidar))
    }

    fn embedding(&self, b: &mut Builder<'_>) -> Tokens {
        let p = prefix(self.scale);
        let tokens = 2 * usize::from(self.grid.0) * usize::from(self.grid.1);
        let position = self.position.then(|| {
            let weights = b.weights(&format!("{p}.pos_emb"), &[1, tokens, self.channels]);
            let data = Arc::unwrap_or_clone(weights).data;
            Arc::new(Weights { shape: vec![tokens, self.channels], data })
        });
        Tokens {
            grid: self.grid,
            position,
            velocity_weights: b.vector(&format!("{p}.vel_emb.weight"), &[self.channels, 1]),
            velocity_bias: b.vector(&format!("{p}.vel_emb.bias"), &[self.channels]),
        }
    }

    fn block(&self, b: &mut Builder<'_>, module: &str, stream: ValueId) -> Result<ValueId> {
        let name = |leaf: &str| format!("{module}.{leaf}");
        let rows = (b.graph.value(stream).shape.height, 1);
        let norm = b.layer_norm(&name("ln1"), self.channels, rows);
        let x = b.push(name("ln1"), Op::LayerNorm(norm), &[stream])?;
        let query = b.linear(&name("attn.query"), x, self.channels)?;
        let key = b.linear(&name("attn.key"), x, self.channels)?;
        let value = b.linear(&name("attn.value"), x, self.channels)?;
        let attention = Op::Attention { heads: b.options.heads.unwrap_or(DEFAULT_HEADS) };
        let context = b.push(name("attn.context"), attention, &[query, key, value]);
        let context = context.map_err(|e| e.with_help("--heads sets the number of heads"))?;
        let branch = b.linear(&name("attn.proj"), context, self.channels)?;
        let stream = b.push(name("attn.add"), Op::Add { clip: Clip::NONE }, &[branch, stream])?;

        let norm = b.layer_norm(&name("ln2"), self.channels, rows);
        let x = b.push(name("ln2"), Op::LayerNorm(norm), &[stream])?;
        let x = b.linear(&name("mlp.0"), x, self.hidden)?;
        let x = b.push(name("mlp.1"), Op::Clip(Clip::RELU), &[x])?;
        let branch = b.linear(&name("mlp.2"), x, self.channels)?;
        b.push(module, Op::Add { clip: Clip::NONE }, &[branch, stream])
    }

    /// Final LayerNorm of one map's tokens, enlarged to the map's size and added to it.
    fn add_back(
        &self,
        b: &mut Builder<'_>,
        side: &str,
        norm: LayerNorm,
        stream: ValueId,
        map: ValueId,
    ) -> Result<ValueId> {
        let p = prefix(self.scale);
        let mut branch = b.push(format!("{p}.ln_f.{side}"), Op::LayerNorm(norm), &[stream])?;
        let size = b.graph.value(map).shape;
        let factor = (size.height / self.grid.0, size.width / self.grid.1);
        if factor != (1, 1) {
            branch = b.push(format!("{p}.upsample.{side}"), Op::ResizeBilinear { factor }, &[branch])?;
        }
        b.push(format!("{p}.add.{side}"), Op::Add { clip: Clip::NONE }, &[branch, map])
    }
}
