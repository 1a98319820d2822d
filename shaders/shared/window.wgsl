// Blurs entries $K, …, $K + 10 of the array `v` by the window of loss_terms.wgsl: defines `$NAME`.
let $NAME = W0 * v[$K + 5] + W1 * (v[$K + 4] + v[$K + 6]) + W2 * (v[$K + 3] + v[$K + 7])
    + W3 * (v[$K + 2] + v[$K + 8]) + W4 * (v[$K + 1] + v[$K + 9]) + W5 * (v[$K] + v[$K + 10]);
