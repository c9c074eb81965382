//! A linear layer out of several, selected by a code.

use super::operands::{Operands, expect};
use super::weighted;
use crate::error::{Error, ErrorCode, Result};
use crate::qmodel::{QRescale, QResidual, QTensorId};

/// `acc = b' + Σ w·q` per position with the block `clamp(command − 1, 0, B − 1)`, then the epilogue.
pub(super) fn branch_linear(
    operands: &Operands,
    input: QTensorId,
    command: QTensorId,
    output: QTensorId,
    branches: u16,
    weights: &[i8],
    rescale: &QRescale,
) -> Result<Vec<f64>> {
    let command = operands.codes(command)?;
    expect("codes of the command", command.len(), 1)?;
    if branches == 0 || rescale.residual != QResidual::None {
        let message = "a branch linear layer has at least one branch and no second term";
        return Err(Error::new(ErrorCode::Malformed, "", message));
    }
    let branch = (command[0] - 1.0).clamp(0.0, f64::from(branches) - 1.0) as usize;
    let channels = usize::from(operands.shape(output)?.channels);
    let depth = usize::from(operands.shape(input)?.channels);
    let all = usize::from(branches) * channels;
    expect("weights", weights.len(), all * depth)?;
    expect("biases", rescale.bias.len(), all)?;
    expect("multipliers", rescale.multipliers.len(), all)?;
    expect("shifts", rescale.shifts.len(), all)?;
    let rows = branch * channels..(branch + 1) * channels;
    let of_branch = QRescale {
        bias: rescale.bias[rows.clone()].to_vec(),
        multipliers: rescale.multipliers[rows.clone()].to_vec(),
        shifts: rescale.shifts[rows.clone()].to_vec(),
        residual: QResidual::None,
        ..*rescale
    };
    weighted::linear(operands, input, output, &weights[rows.start * depth..rows.end * depth], &of_branch)
}

#[cfg(test)]
mod tests {
    use crate::error::Result;
    use crate::integer_reference::testing::{Random, clamp, execute_alone, rescale_code};
    use crate::qmodel::{QOp, QRescale, QResidual, QTensorId};
    use firmware::tensor::{ElementType, Shape};

    const BRANCHES: usize = 4;
    const INPUTS: usize = 9;
    const OUTPUTS: usize = 5;

    fn rescale(random: &mut Random) -> QRescale {
        QRescale {
            pre_shift: 1,
            bias: random.vec(BRANCHES * OUTPUTS, -50_000, 50_000),
            multipliers: random.vec(BRANCHES * OUTPUTS, 1 << 23, (1 << 24) - 1),
            shifts: random.vec(BRANCHES * OUTPUTS, 30, 34),
            zero_point: -3,
            clamp: clamp(-3, 127),
            residual: QResidual::None,
        }
    }

    fn run(weights: Vec<i8>, rescale: QRescale, input: &[f64], command: f64) -> Result<Vec<f64>> {
        let op = QOp::BranchLinear {
            input: QTensorId(0),
            command: QTensorId(1),
            output: QTensorId(2),
            branches: BRANCHES as u16,
            weights,
            wide: false,
            rescale,
        };
        let positions = (input.len() / INPUTS) as u16;
        let operands = [
            (Shape::tokens(positions, INPUTS as u16), ElementType::I8, input.to_vec()),
            (Shape::vector(1), ElementType::I8, vec![command]),
        ];
        execute_alone(op, &operands, (Shape::tokens(positions, OUTPUTS as u16), ElementType::I8))
    }

    #[test]
    fn the_command_selects_the_block_and_saturates() {
        let seed = 0xb1a;
        let mut random = Random(seed);
        let weights: Vec<i8> = random.vec(BRANCHES * OUTPUTS * INPUTS, -127, 127);
        let (rescale, input) = (rescale(&mut random), random.codes(2 * INPUTS, -128, 127));
        let expected = |branch: usize| -> Vec<f64> {
            let code = |row: &[f64], o: usize| {
                let o = branch * OUTPUTS + o;
                let products = row.iter().zip(&weights[o * INPUTS..]).map(|(&q, &w)| q as i128 * i128::from(w));
                rescale_code(&rescale, o, products.sum(), 0) as f64
            };
            input.chunks(INPUTS).flat_map(|row| (0..OUTPUTS).map(move |o| code(row, o))).collect()
        };
        for (command, branch) in [(-128.0, 0), (0.0, 0), (1.0, 0), (2.0, 1), (3.0, 2), (4.0, 3), (5.0, 3), (127.0, 3)] {
            let found = run(weights.clone(), rescale.clone(), &input, command).unwrap();
            assert_eq!(found, expected(branch), "command {command}, seed {seed:#x}");
        }
        assert_ne!(expected(0), expected(1));
    }

    #[test]
    fn misfitting_arrays_and_a_second_term_are_malformed() {
        let mut random = Random(1);
        let message = |weights: usize, rescale: QRescale| {
            run(vec![1; weights], rescale, &[0.0; INPUTS], 1.0).unwrap_err().to_string()
        };
        let good = rescale(&mut random);
        assert!(message(179, good.clone()).contains("weights: found 179, expected 180"));
        let short = QRescale { bias: vec![0; OUTPUTS], ..good.clone() };
        assert!(message(180, short).contains("biases: found 5, expected 20"));
        let residual = QRescale { residual: QResidual::Stream { tensor: QTensorId(0) }, ..good };
        assert!(message(180, residual).contains("no second term"));
    }
}
