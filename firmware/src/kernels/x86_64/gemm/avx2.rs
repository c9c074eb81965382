//! The tile for AVX2: codes and weights in 16 bits, `vpmaddwd` adds the products of two depth elements exactly
//! (2·2^15·2^7 < 2^31).
//!
//! `vpmaddubsw` on codes + 128 would take half the instructions, but saturates: 2·255·127 > 2^15.

use super::epilogue::Epilogue;
use super::{BLOCKS, CHANNELS, Operands, ROWS, Sums, Tile};
use crate::kernels::k4n16::{COMPENSATION_BYTES, QUAD, QUAD_BYTES};
use crate::kernels::portable::codes::Code;
use crate::kernels::x86_64::Avx2;
use core::arch::x86_64::{
    __m256i, _mm_loadu_si128, _mm256_add_epi32, _mm256_cvtepi8_epi16, _mm256_hadd_epi32, _mm256_madd_epi16,
    _mm256_permute4x64_epi64, _mm256_set1_epi64x, _mm256_setzero_si256, _mm256_storeu_si256,
};

/// Output channels that a pass over the depth computes: half a block, so that 6 rows of sums stay in registers.
const HALF: usize = 8;

impl Tile for Avx2 {
    type Code = i16;

    fn widen(self, codes: &[i8], row: &mut [i16]) {
        // SAFETY: the token proves that the instructions exist.
        unsafe { widen(codes, row) }
    }

    fn accumulate(self, operands: &Operands<'_, i16>, sums: &mut Sums) {
        // SAFETY: the token proves that the instructions exist.
        unsafe { accumulate(operands, sums) }
    }

    fn finish<T: Code>(self, epilogue: &Epilogue<'_>, sums: &[[i32; CHANNELS]], first: usize, output: &mut [T]) {
        // SAFETY: the token proves that the instructions exist.
        unsafe { finish(epilogue, sums, first, output) }
    }
}

#[target_feature(enable = "avx2")]
fn widen(codes: &[i8], row: &mut [i16]) {
    for (wide, code) in row.iter_mut().zip(codes) {
        *wide = i16::from(*code);
    }
}

#[target_feature(enable = "avx2")]
fn finish<T: Code>(epilogue: &Epilogue<'_>, sums: &[[i32; CHANNELS]], first: usize, output: &mut [T]) {
    epilogue.finish(sums, first, output);
}

#[target_feature(enable = "avx2")]
fn accumulate(operands: &Operands<'_, i16>, sums: &mut Sums) {
    let &Operands { rows, stride, quads, weights, block_bytes } = operands;
    let rows_fit = quads * QUAD <= stride && rows.len() == ROWS * stride;
    if !(rows_fit && COMPENSATION_BYTES + quads * QUAD_BYTES <= block_bytes && weights.len() <= BLOCKS * block_bytes) {
        return;
    }
    let halves = weights.chunks_exact(block_bytes).flat_map(|block| {
        let (quads, _) = block.split_at(COMPENSATION_BYTES).1.as_chunks::<QUAD_BYTES>();
        [0, QUAD_BYTES / 2].map(|first| (quads, first))
    });
    for (half, (columns, first)) in halves.enumerate() {
        // Per row two vectors of 4 channels, each channel's sum in two parts.
        let mut acc = [[_mm256_setzero_si256(); 2]; ROWS];
        for (quad, column) in columns.iter().take(quads).enumerate() {
            // SAFETY: 16 bytes from `first` (0 or 32) and from `first + 16` lie inside the 64 of a column.
            let low = unsafe { _mm_loadu_si128(column.as_ptr().add(first).cast()) };
            // SAFETY: as above.
            let high = unsafe { _mm_loadu_si128(column.as_ptr().add(first + 16).cast()) };
            let columns = [_mm256_cvtepi8_epi16(low), _mm256_cvtepi8_epi16(high)];
            for (row, acc) in acc.iter_mut().enumerate() {
                // SAFETY: quad `quad` of row `row` ends inside the row (`rows_fit`).
                let codes = unsafe { rows.as_ptr().add(row * stride + quad * QUAD).cast::<i64>().read_unaligned() };
                let codes = _mm256_set1_epi64x(codes);
                for (acc, column) in acc.iter_mut().zip(columns) {
                    *acc = _mm256_add_epi32(*acc, _mm256_madd_epi16(codes, column));
                }
            }
        }
        for (sums, [low, high]) in sums.iter_mut().zip(acc) {
            if let Some(sums) = sums.get_mut(half * HALF..).and_then(<[i32]>::first_chunk_mut::<HALF>) {
                // SAFETY: `sums` is an array of 8 times 32 bits; the store needs no alignment.
                unsafe { _mm256_storeu_si256(sums.as_mut_ptr().cast(), join(low, high)) };
            }
        }
    }
}

/// Adds the two parts of each sum: channels 0 to 3 of `low`, 4 to 7 of `high`.
#[target_feature(enable = "avx2")]
fn join(low: __m256i, high: __m256i) -> __m256i {
    // The horizontal sum gives channels 0 1 4 5 2 3 6 7.
    _mm256_permute4x64_epi64::<0b11_01_10_00>(_mm256_hadd_epi32(low, high))
}
