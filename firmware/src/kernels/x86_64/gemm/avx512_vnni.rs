//! The tile for AVX-512 VNNI: `vpdpbusd` multiplies unsigned codes (raised by 128) with signed weights, four depth
//! elements of 16 output channels at once, and adds exactly; the packed compensation takes the 128 out again.

use super::epilogue::Epilogue;
use super::{BLOCKS, CHANNELS, Operands, ROWS, Sums, Tile};
use crate::kernels::k4n16::{COMPENSATION_BYTES, OUTPUTS, QUAD, QUAD_BYTES};
use crate::kernels::portable::codes::Code;
use crate::kernels::x86_64::Avx512Vnni;
use core::arch::x86_64::{
    _mm512_dpbusd_epi32, _mm512_loadu_si512, _mm512_set1_epi32, _mm512_setzero_si512, _mm512_storeu_si512,
};

impl Tile for Avx512Vnni {
    type Code = u8;

    fn widen(self, codes: &[i8], row: &mut [u8]) {
        // SAFETY: the token proves that the instructions exist.
        unsafe { widen(codes, row) }
    }

    fn accumulate(self, operands: &Operands<'_, u8>, sums: &mut Sums) {
        // SAFETY: the token proves that the instructions exist.
        unsafe {
            match operands.weights.len().checked_div(operands.block_bytes) {
                Some(1) => accumulate::<1>(operands, sums),
                Some(2) => accumulate::<2>(operands, sums),
                Some(3) => accumulate::<3>(operands, sums),
                Some(BLOCKS) => accumulate::<BLOCKS>(operands, sums),
                _ => {}
            }
        }
    }

    fn finish<T: Code>(self, epilogue: &Epilogue<'_>, sums: &[[i32; CHANNELS]], first: usize, output: &mut [T]) {
        // SAFETY: the token proves that the instructions exist.
        unsafe { finish(epilogue, sums, first, output) }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn widen(codes: &[i8], row: &mut [u8]) {
    for (raised, code) in row.iter_mut().zip(codes) {
        *raised = code.cast_unsigned() ^ 0x80;
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl")]
fn finish<T: Code>(epilogue: &Epilogue<'_>, sums: &[[i32; CHANNELS]], first: usize, output: &mut [T]) {
    epilogue.finish(sums, first, output);
}

/// `N` blocks: 6·N sums of 16 output channels stay in registers over the whole depth.
#[target_feature(enable = "avx512f,avx512bw,avx512dq,avx512vl,avx512vnni")]
fn accumulate<const N: usize>(operands: &Operands<'_, u8>, sums: &mut Sums) {
    let &Operands { rows, stride, quads, weights, block_bytes } = operands;
    let rows_fit = quads * QUAD <= stride && rows.len() == ROWS * stride;
    let weights_fit = COMPENSATION_BYTES + quads * QUAD_BYTES <= block_bytes && weights.len() == N * block_bytes;
    if !(rows_fit && weights_fit && N <= BLOCKS) {
        return;
    }
    let (rows, weights) = (rows.as_ptr(), weights.as_ptr());
    let mut acc = [[_mm512_setzero_si512(); N]; ROWS];
    for block in 0..N {
        // SAFETY: a block begins with 64 bytes of compensations, and `weights` holds N blocks.
        let compensations = unsafe { _mm512_loadu_si512(weights.add(block * block_bytes).cast()) };
        acc.iter_mut().for_each(|acc| acc[block] = compensations);
    }
    for quad in 0..quads {
        let mut columns = [_mm512_setzero_si512(); N];
        for (block, column) in columns.iter_mut().enumerate() {
            // SAFETY: quad `quad` of block `block` ends inside the block (`weights_fit`).
            let at = unsafe { weights.add(block * block_bytes + COMPENSATION_BYTES + quad * QUAD_BYTES) };
            // SAFETY: as above; the load needs no alignment.
            *column = unsafe { _mm512_loadu_si512(at.cast()) };
        }
        for (row, acc) in acc.iter_mut().enumerate() {
            // SAFETY: quad `quad` of row `row` ends inside the row (`rows_fit`).
            let codes = unsafe { rows.add(row * stride + quad * QUAD).cast::<i32>().read_unaligned() };
            let codes = _mm512_set1_epi32(codes);
            for (acc, column) in acc.iter_mut().zip(columns) {
                *acc = _mm512_dpbusd_epi32(*acc, codes, column);
            }
        }
    }
    for (sums, acc) in sums.iter_mut().zip(acc) {
        for (sums, acc) in sums.as_chunks_mut::<OUTPUTS>().0.iter_mut().zip(acc) {
            // SAFETY: `sums` is an array of 16 times 32 bits; the store needs no alignment.
            unsafe { _mm512_storeu_si512(sums.as_mut_ptr().cast(), acc) };
        }
    }
}
