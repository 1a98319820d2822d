// Adds a row to the sums of column $K except the one it completes, moving each to the place of the window one row
// further up.
part[10 * $K] = part[10 * $K + 1] + W4 * blurred;
part[10 * $K + 1] = part[10 * $K + 2] + W3 * blurred;
part[10 * $K + 2] = part[10 * $K + 3] + W2 * blurred;
part[10 * $K + 3] = part[10 * $K + 4] + W1 * blurred;
part[10 * $K + 4] = part[10 * $K + 5] + W0 * blurred;
part[10 * $K + 5] = part[10 * $K + 6] + W1 * blurred;
part[10 * $K + 6] = part[10 * $K + 7] + W2 * blurred;
part[10 * $K + 7] = part[10 * $K + 8] + W3 * blurred;
part[10 * $K + 8] = part[10 * $K + 9] + W4 * blurred;
part[10 * $K + 9] = W5 * blurred;
